"""What messages say: decoded by the standard definitions of ROS, never by code made from a recording."""

from functools import lru_cache
from typing import Any

from calib_toolkit.errors import DataError
from calib_toolkit_datasets.bags.containers import fetch
from calib_toolkit_datasets.bags.index import LARGEST, STAMPED, Channel, Key, Source

FRAMES = {"tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"}
READ = STAMPED | FRAMES
"""Types of messages that are decoded."""
LONGEST_DEFINITION = 100_000


def load(key: Key, source: Source, topic: str, kind: str, encoding: str) -> Any:
    """One message as its fields. Raises DataError, naming file, topic and place."""
    return decode(fetch(source, key), kind, encoding, place(key, source, topic))


def place(key: Key, source: Source, topic: str) -> str:
    """File, topic and message, as sentences begin with them."""
    where = f"message {key[2]}" if source.storage == "sqlite" else f"the message at byte {key[1] or key[2]}"
    return f"{source.files[key[0]]}: {topic}: {where}"


def decode(data: bytes, kind: str, encoding: str, where: str) -> Any:
    """A message of one of the types ``READ``. Raises DataError; the sentence begins with ``where``."""
    from rosbags.serde import SerdeError

    store = types(encoding)
    try:
        return store.deserialize_ros1(data, kind) if encoding == "ros1" else store.deserialize_cdr(data, kind)
    except (SerdeError, ValueError, IndexError, TypeError, OverflowError, MemoryError, AssertionError) as e:
        raise DataError(
            f"{where} is not a whole {short(kind)} ({' '.join(str(e).split())[:120]}); leave it out"
        ) from e


def encode(message: Any, encoding: str) -> bytes:
    """The bytes of a message."""
    store, kind = types(encoding), message.__msgtype__
    return bytes(
        store.serialize_ros1(message, kind)
        if encoding == "ros1"
        else store.serialize_cdr(message, kind, little_endian=True)
    )


@lru_cache(maxsize=2)
def types(encoding: str) -> Any:
    """The standard messages, as ROS 1 (``ros1``) or ROS 2 (``cdr``) has them."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)
    store.max_sequence_length = LARGEST
    for kind in sorted(FRAMES - store.fielddefs.keys()):
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", kind))
    return store


def short(kind: str) -> str:
    """A type's name without its package."""
    return kind.rpartition("/")[2]


def spoken(kind: str) -> str:
    """A type as people write it, without the part that ROS 2 put in."""
    return kind.replace("/msg/", "/")


def unreadable(channel: Channel) -> str:
    """Why messages of a channel can not be read, in a few words; "" if they can."""
    if channel.type not in READ:
        return "no sensor reads this type"
    if channel.encoding not in ("ros1", "cdr"):
        return f"its encoding '{channel.encoding}' is neither ros1 nor cdr"
    return _other(channel)


def _other(channel: Channel) -> str:
    """Whether the recording defines a type otherwise than ROS does."""
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    if not channel.definition:
        return ""
    if len(channel.definition) > LONGEST_DEFINITION:
        return "its definition is too long"
    try:
        text = channel.definition
        found = get_types_from_idl(text) if channel.idl else get_types_from_msg(text, channel.type)
        own = _fields(found[channel.type][1])
    except Exception as e:  # of a parser given anything
        return f"its definition can not be understood ({type(e).__name__})"
    standard = _fields(types(channel.encoding).fielddefs[channel.type][1])
    if own == standard and list(own) == list(standard):
        return ""
    if not own:
        return "its definition holds no fields"
    odd = [n for n in standard if own.get(n) != standard[n]] or [n for n in own if n not in standard]
    return f"its definition differs from ROS's own in the field '{(odd or [*standard])[0]}'"


def _fields(fields: Any) -> dict[str, Any]:
    return {name.lower(): kind for name, kind in fields}
