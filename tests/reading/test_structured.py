"""JSON and YAML: values are counted before they are made, and each mistake has its line."""

from __future__ import annotations

import pytest

from acsar_gym.errors import ConfigError
from acsar_gym.reading import format_yaml, parse_json, parse_yaml


@pytest.mark.parametrize("text", ["[[],[],[]]", '{"a": {}, "b": {}}', "[1, 2, 3, 4]"])
def test_values_of_json_are_counted(text: str) -> None:
    parse_json(text, most=6)
    with pytest.raises(ConfigError, match="has more than 2 values"):
        parse_json(text, most=2)


@pytest.mark.parametrize(
    "text", ["NaN", "-Infinity", "1e999", "[" * 100_000, "9" * 5_000, "[1,]", b"\xff", ""]
)
def test_bad_json_is_one_line(text: str | bytes) -> None:
    with pytest.raises(ConfigError, match=r"^not valid JSON: ") as error:
        parse_json(text)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: 1\nb: [", "line 3, column 1"),
        ("a: &x 1\nb: *x", "line 2: has an alias"),
        ("a: 1\n2: 3", "line 2: a key must be text"),
        ("a: 1\n<<: {b: 2}", "line 2: a key must be text, in quotes if need be (<< is refused"),
        ("[" * 21, "nested too deeply"),
        ("[" + "0," * 20_000 + "]", "too many values"),
        (f"a: {'x' * 10_001}", "line 1: a text of 10,001 characters"),
        ("a: 1\n--- \nb: 2", "line 2"),
        ("!!python/object/apply:os.abort []", "could not determine a constructor"),
    ],
)
def test_bad_yaml_is_one_line_that_tells_where(text: str, said: str) -> None:
    with pytest.raises(ConfigError) as error:
        parse_yaml(text)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_what_is_written_is_read_back() -> None:
    same = [1, 2]
    data = {"a": same, "b": same, "c": "1e-3", "d": 1e-5, "e": None, "f": {"g": True}}
    assert parse_yaml(format_yaml(data)) == data
