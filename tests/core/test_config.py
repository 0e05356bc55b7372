"""Options: what a file may set, and what is refused by name."""

from dataclasses import asdict

import pytest

from calib_toolkit.config import Config, read_config
from calib_toolkit.errors import ConfigError
from calib_toolkit.rotation import RotationOptions
from calib_toolkit.timing import TimingOptions


@pytest.fixture
def read(tmp_path):
    def read(text, **overrides):
        (tmp_path / "options.toml").write_text(text)
        return read_config(tmp_path / "options.toml", **overrides)

    return read


def test_the_defaults_of_the_papers_method_are_the_papers():
    c = Config()
    assert c.timing.steps == 10_000  # VI-A1
    assert (c.timing.trim, c.rotation.trim, c.translation.trim) == (0.25, 0.25, 0.25)  # VI-C1
    assert c.sync.gate == 10.0  # VI-A1
    assert c.jobs >= 1


def test_the_method_is_joint_unless_chosen(read):
    assert Config().method == "joint"
    assert read('method = "paper"').method == "paper"


def test_an_empty_file_changes_nothing(read):
    assert read("") == Config()


def test_what_is_set_is_set_and_the_rest_stays(read):
    c = read('base = "ins"\nduration = 30\n[timing]\nsteps = 500\n[sensors.velo]\ngate = 0.3\n')
    assert (c.base, c.duration, c.timing.steps, c.timing.trim) == ("ins", 30, 500, 0.25)
    assert c.sensors == {"velo": {"gate": 0.3}}
    assert c.rotation == RotationOptions()


def test_whole_numbers_stand_for_real_ones(read):
    c = read("start = 3\n[rotation]\ntrim = 0\n")
    assert (c.start, c.rotation.trim) == (3.0, 0.0)
    assert isinstance(c.start, float)


def test_overrides_come_before_the_file(read):
    c = read("seed = 4\nstart = 3.0\n", seed=9)
    assert (c.seed, c.start) == (9, 3.0)


def test_overrides_are_checked_as_the_file_is(read):
    with pytest.raises(ConfigError, match="duration"):
        read("", duration=-1.0)


def test_a_configuration_can_be_written_down():
    plain = asdict(Config(sensors={"velo": {"gate": 0.3}}))
    assert plain["timing"]["max_offset"] == 5.0
    assert plain["sensors"] == {"velo": {"gate": 0.3}}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("colour = 1", "'colour', which does not exist; there are: .*duration"),
        ("[timing]\ncolour = 1", r"options.toml \[timing\] sets 'colour', .*max_offset"),
        ("timing = 1", r"timing is a table; write \[timing\]"),
        ("sensors = 1", r"sensors is a table"),
        ("[sensors]\nvelo = 1", r"sensors.velo is a table"),
        ("seed = 'x'", "seed is 'x', where an? int is expected"),
        ("seed = 1.5", "seed is 1.5"),
        ("seed = true", "seed is True"),
        ("start = '3'", "start is '3'"),
        ("method = 3", "method is 3"),
        ("duration = '3'", "duration"),
        ("[timing]\nsteps = 100.5", "steps is 100.5"),
        ("[[timing]]\nsteps = 100", "timing is a table"),
        ("a = [", "can not be read as TOML"),
    ],
)
def test_what_does_not_fit_is_refused_by_name(read, text, words):
    with pytest.raises(ConfigError, match=words):
        read(text)


@pytest.mark.parametrize(
    "options",
    [
        {"method": "guess"},
        {"duration": 0.0},
        {"duration": float("nan")},
        {"duration": float("inf")},
        {"start": -1.0},
        {"start": float("nan")},
        {"jobs": 0},
        {"timing": TimingOptions(steps=0)},
        {"timing": TimingOptions(steps=10**9)},
        {"timing": TimingOptions(max_offset=0.0)},
        {"timing": TimingOptions(start="guess")},
        {"timing": TimingOptions(trim=1.0)},
        {"rotation": RotationOptions(trim=float("nan"))},
    ],
)
def test_values_beyond_their_range_are_refused(options):
    (name,) = options
    with pytest.raises(ConfigError, match=name):
        Config(**options)


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"none\.toml"):
        read_config(tmp_path / "none.toml")
