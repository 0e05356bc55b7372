"""Measured numbers from a file: read as they are meant, and every slip refused in one sentence."""

import math
import re
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calib_toolkit.errors import DataError
from calib_toolkit.prior_file import KEYS, read_prior
from calib_toolkit.types import Measured


@pytest.fixture
def file(tmp_path):
    """Writes a prior file."""

    def write(text):
        (tmp_path / "measured.toml").write_text(text, encoding="utf-8")
        return tmp_path / "measured.toml"

    return write


def test_every_key_becomes_its_parameter_in_si_units(file):
    pairs = {key: (k + 1.0, 0.1 * (k + 1)) for k, key in enumerate(KEYS)}
    prior = read_prior(file("[cam0]\n" + "".join(f"{key} = [{v}, {s}]\n" for key, (v, s) in pairs.items())))
    assert prior.base is None
    assert [m.sensor for m in prior.numbers] == ["cam0"] * 7
    assert [m.parameter for m in prior.numbers] == ["x", "y", "z", "roll", "pitch", "yaw", "dt"]
    expected = [1.0, 2.0, 3.0, math.radians(4), math.radians(5), math.radians(6), 0.007]
    assert [m.value for m in prior.numbers] == pytest.approx(expected)
    assert [m.sigma for m in prior.numbers] == pytest.approx([0.1 * v for v in expected])


def test_several_sensors_and_a_base(file):
    prior = read_prior(file('base = "velo"\n[cam0]\nz = [0, 1]\n["head 1"]\ndt_ms = [12, 2]\n'))
    assert prior.base == "velo"
    assert prior.numbers == (Measured("cam0", "z", 0.0, 1.0), Measured("head 1", "dt", 0.012, 0.002))


def test_a_sensor_may_be_called_base(file):
    prior = read_prior(file("[base]\nx = [1, 0.1]"))
    assert prior.base is None
    assert prior.numbers[0].sensor == "base"


def test_the_example_in_the_documents_is_accepted(file):
    page = Path(__file__).parents[2].joinpath("docs/formats.md").read_text(encoding="utf-8")
    (section,) = re.findall(r"## Measured numbers\n(.*?)\n## ", page, re.DOTALL)
    text = "\n".join(line[4:] for line in section.splitlines() if line.startswith("    "))
    prior = read_prior(file(text))
    assert prior.base == "velo"
    assert [(m.sensor, m.parameter) for m in prior.numbers] == [("cam0", "z"), ("cam0", "yaw"), ("ins", "dt")]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("[cam0", "can not be read as TOML"),
        ("[cam0]\nz = [1, 2]\nz = [1, 2]", "can not be read as TOML"),
        ("x = " + "[" * 100_000, "can not be read as TOML"),
        ("", r"holds no measured number; give a sensor's table one, such as z = \[1.20, 0.02\]"),
        ('base = "velo"', "holds no measured number"),
        ("[cam0]\n[cam1]", "holds no measured number"),
        ("cam0 = [1.0, 0.1]", r"cam0 = \[1.0, 0.1\] is no table; write \[cam0\]"),
        ("[[cam0]]\nz = [1, 0.1]", r"is no table; write \[cam0\]"),
        ("base = 3", r"base = 3 is no table"),
        (
            "[cam0]\nyaw = [1, 0.1]",
            r"sets 'yaw' for cam0, which does not exist; there are: x, y, z, roll_deg, .*dt_ms",
        ),
        ("[sensors.cam0]\nz = [1, 0.1]", r"sets 'cam0' for sensors, which does not exist"),
        ("[cam0]\nz = 1.0", r"z of cam0 is 1.0; give \[value, sigma\]"),
        ("[cam0]\nz = [1.0]", r"z of cam0 is \[1.0\]; give \[value, sigma\]"),
        ("[cam0]\nz = [1.0, 0.1, 3]", r"give \[value, sigma\], two numbers"),
        ('[cam0]\nz = ["1", 0.1]', r"give \[value, sigma\], two numbers"),
        ("[cam0]\nz = [true, 0.1]", r"give \[value, sigma\], two numbers"),
        ("[cam0]\nz = [[1], 0.1]", r"give \[value, sigma\], two numbers"),
        ("[cam0]\nz = {value = 1, sigma = 2}", r"give \[value, sigma\], two numbers"),
        ("[cam0]\nz = [nan, 0.1]", r"z of cam0 is \[nan, 0.1\]; give"),
        ("[cam0]\nz = [1, inf]", r"z of cam0 is \[1, inf\]; give"),
        ("[cam0]\nz = [1, nan]", r"z of cam0 is \[1, nan\]; give"),
        ("[cam0]\nz = [1, 0]", r"the sigma of cam0's z is 0; give how sure the value is, above zero"),
        ("[cam0]\nz = [1, 1e-200]", r"the sigma of cam0's z is 1e-200"),
        ("[cam0]\nz = [1e300, 1]", r"z of cam0 is \[1e\+300, 1\]; give"),
        ("[cam0]\nyaw_deg = [1, -0.5]", r"the sigma of cam0's yaw_deg is -0.5"),
        ('base = "velo"\n[velo]\nz = [1, 0.1]', "velo is the base, so its pose and offset are zero by definition"),
    ],
)
def test_every_slip_is_refused_in_one_sentence(file, text, sentence):
    with pytest.raises(DataError, match=sentence) as refused:
        read_prior(file(text))
    assert "measured.toml" in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("content", [b"\xff\xfe\x00", b"\x89PNG\r\n"])
def test_what_is_no_text_is_refused_by_name(tmp_path, content):
    (tmp_path / "measured.toml").write_bytes(content)
    with pytest.raises(DataError, match=r"measured\.toml can not be read as TOML"):
        read_prior(tmp_path / "measured.toml")


def test_a_file_that_is_not_there_is_refused_by_name(tmp_path):
    with pytest.raises(DataError, match=r"none\.toml can not be read"):
        read_prior(tmp_path / "none.toml")
    with pytest.raises(DataError, match="can not be read"):
        read_prior(tmp_path)


scalars = st.one_of(st.integers(-(10**400), 10**400), st.floats(), st.booleans(), st.text("ab", max_size=2))


@settings(max_examples=50)
@given(st.sampled_from([*KEYS, "yaw", "t"]), st.lists(scalars, max_size=3))
def test_whatever_is_accepted_is_finite_with_a_positive_sigma(tmp_path_factory, key, pair):
    def toml(x):
        return str(x).lower() if isinstance(x, bool) else repr(x)

    file = tmp_path_factory.getbasetemp() / "any.toml"
    file.write_text(f"[cam0]\n{key} = [{', '.join(map(toml, pair))}]\n")
    try:
        (number,) = read_prior(file).numbers
    except DataError:
        return
    assert key in KEYS
    assert math.isfinite(number.value)
    assert math.isfinite(number.sigma**-2)
