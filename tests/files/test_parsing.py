"""What stands between a stranger's text and a dataclass."""

import gzip
from dataclasses import dataclass
from typing import Annotated

import pytest
from gaitgauge.files.parsing import (
    bare_name,
    build,
    from_text,
    one_line,
    parse_json,
    parse_toml,
    parse_yaml,
    read_text,
    shown,
)
from pydantic import Field


class TextError(ValueError):
    pass


@dataclass(frozen=True, kw_only=True)
class Leg:
    name: str
    length: Annotated[float, Field(gt=0.0)] = 1.0
    toes: Annotated[int, Field(ge=1)] | None = 5

    def __post_init__(self):
        if self.name == "tail":
            raise TextError("a tail is no leg")


@dataclass(frozen=True, kw_only=True)
class Animal:
    legs: tuple[Leg, ...]
    age: int | None = None
    eyes: tuple[float, float] = (0.0, 0.0)


def test_numbers_lists_and_tables_become_fields():
    made = build(Animal, {"legs": [{"name": "left", "length": 2}], "eyes": [1, 2.5]}, "zoo", TextError)
    assert made == Animal(legs=(Leg(name="left", length=2.0),), eyes=(1.0, 2.5))
    assert type(made.legs[0].length) is type(made.eyes[0]) is float


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        ({"legs": [{"name": "a", "lenght": 1}]}, "zoo: unknown field 'legs[0].lenght'; did you mean 'length'?"),
        ({"legs": [{"name": "a", "length": 0}]}, "zoo: legs[0].length is 0; it must be greater than 0"),
        ({"legs": [{}]}, "zoo: legs[0] lacks name"),
        ({}, "zoo: it lacks legs"),
        ([], "zoo: it is []; it must be a table"),
        ({"legs": [{"name": "tail"}]}, "zoo: legs[0] a tail is no leg"),
        ({"legs": [], "age": True}, "zoo: age is True; it must be a whole number"),
        ({"legs": [], "age": "3\n\x1b[31m" + "x" * 500}, None),
        ({"legs": [], "eyes": [float("nan"), 1]}, "zoo: eyes[0] is nan; it must be a finite number"),
        ({"legs": {1, 2}}, "zoo: legs is {1, 2}; it must be a text, a number, a list or a table"),
        ({3: 4}, "zoo: a table has the key 3; keys must be texts"),
    ],
)
def test_mistakes_are_sentences_with_place_and_value(data, sentence):
    with pytest.raises(TextError) as caught:
        build(Animal, data, "zoo", TextError)
    assert str(caught.value) == (sentence or str(caught.value))
    assert len(str(caught.value)) < 200
    assert str(caught.value).isprintable()


def test_false_stands_for_none_where_the_file_has_no_other_word():
    made = build(Animal, {"legs": [{"name": "hoof", "toes": False}]}, "zoo", TextError, false_is_none=True)
    assert made == Animal(legs=(Leg(name="hoof", toes=None),))


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        ({"legs": [], "age": "old"}, "zoo: age is 'old'; it must be a whole number, or false"),
        (
            {"legs": [{"name": "a", "toes": 0}]},
            "zoo: legs[0].toes is 0; it must be greater than or equal to 1, or false",
        ),
        ({"legs": [{"name": "a", "length": False}]}, "zoo: legs[0].length is False; it must be a number"),
        ({"legs": False}, "zoo: legs is False; it must be a list"),
        ({"legs": [], "agee": False}, "zoo: unknown field 'agee'; did you mean 'age'?"),
    ],
)
def test_where_false_may_stand_is_said(data, sentence):
    with pytest.raises(TextError) as caught:
        build(Animal, data, "zoo", TextError, false_is_none=True)
    assert str(caught.value) == sentence


LAUGHS = "a0: &a0 [1, 1]\n" + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 9))
"""Nine times as many entries with every line."""


@pytest.mark.parametrize(
    ("parse", "text"),
    [
        (parse_json, "[" * 100_000),
        (parse_json, "[" * 50 + "]" * 50),
        (parse_json, "9" * 5000),
        (parse_json, "9" * 100),
        (parse_json, "{"),
        (parse_json, "[" + "1," * 200_000 + "1]"),
        (parse_toml, "a = " + "[" * 10_000),
        (parse_toml, "a = " + "{b=" * 200 + "1" + "}" * 200),
        (parse_toml, "a = 1\na = 2"),
        (parse_yaml, "[" * 10_000),
        (parse_yaml, "{" * 10_000),
        (parse_yaml, "a: &a [*a]"),
        (parse_yaml, "a: !!bool maybe"),
        (parse_yaml, "a: 0x" + "f" * 5000),
        (parse_yaml, "a: 0b" + "1" * 20_000),
        (parse_toml, "a = 0x" + "f" * 5000),
        (parse_yaml, LAUGHS),
        (parse_yaml, "a: &a {x: 1}\nb: {<<: *a}"),
        (parse_yaml, "a: !!python/object/apply:os.system [ls]"),
        (parse_yaml, "a: 2020-99-99"),
        (parse_yaml, "a: 2020-01-01"),
        (parse_yaml, "? [1]\n: 2"),
        (parse_yaml, "a: !!binary x"),
        (parse_yaml, "a: !!int x"),
        (parse_yaml, "a: !!timestamp x"),
        (parse_yaml, "a: b: c"),
    ],
)
def test_hostile_texts_are_refused(parse, text):
    with pytest.raises(TextError, match=r"^zoo") as caught:
        parse(text, "zoo", TextError)
    assert len(str(caught.value)) < 500
    assert str(caught.value).isprintable()


def test_halves_of_surrogate_pairs_become_text():
    assert parse_json('{"a\\ud800": "\\udfff"}', "zoo", TextError) == {"a\\ud800": "\\udfff"}


def test_files_have_a_size(tmp_path):
    path = tmp_path / "zoo.toml"
    path.write_bytes(b"\xef\xbb\xbfa = 1")
    assert read_text(path, "zoo file", TextError) == "a = 1"
    path.write_bytes(b"a = 1 # " + b"x" * 100)
    with pytest.raises(TextError, match="larger than"):
        read_text(path, "zoo file", TextError, largest=100)
    path.write_bytes(b"a = \xff")
    with pytest.raises(TextError, match=r"zoo file '.*zoo.toml' is not a UTF-8 text file"):
        read_text(path, "zoo file", TextError)


def test_packed_files_are_read_and_have_the_same_size(tmp_path):
    path, packed = tmp_path / "card.json.gz", gzip.compress(b"a" * 1000)
    path.write_bytes(packed)
    assert read_text(path, "card", TextError) == "a" * 1000
    with pytest.raises(TextError, match="larger than"):
        read_text(path, "card", TextError, largest=999)
    for damaged in (b"{}", packed[:-9], packed[:12] + b"\xff" * 20):
        path.write_bytes(damaged)
        with pytest.raises(TextError, match=r"card '.*card.json.gz' cannot be read: it is damaged, or no gzip file"):
            read_text(path, "card", TextError)


@pytest.mark.parametrize(
    ("hint", "text", "value"),
    [
        (int, "5", 5),
        (float | None, "none", None),
        (tuple[float, ...], "(1, 2)", (1.0, 2.0)),
        (Annotated[tuple[str, ...], Field(min_length=1)], "a,b", ("a", "b")),
        (float | Leg, "0.5", 0.5),
        (bool, "false", False),
    ],
)
def test_settings_take_the_type_of_the_field(hint, text, value):
    assert from_text(hint, text, "key", TextError) == value


@pytest.mark.parametrize("text", ["fast", "nan", "0", "-1", "1e400"])
def test_settings_out_of_range_name_the_key(text):
    with pytest.raises(TextError, match=f"'leg.length' is '{text}'; it must be"):
        from_text(Annotated[float, Field(gt=0.0)], text, "leg.length", TextError)


def test_shown_values_are_short_and_printable():
    for value in ("x" * 10_000, 10**4000, "\x1b[31m", ["x" * 100] * 100, {"a": [[[[[[[1]]]]]]]}, "\ud800"):
        assert len(shown(value)) <= 80
        assert shown(value).isprintable()
    assert one_line("a\nb\x07" + "c" * 400).startswith("a b\\x07cc")


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("cards/pretrained-robogauge-1.1.json", "pretrained-robogauge-1.1"),
        ("robogauge-1.1", "robogauge-1.1"),
        ("mine.gauge.pt", "mine"),
        ("runs/a/model_50.pt", "model_50"),
        ("C:\\policies\\trot.v2.onnx", "trot.v2"),
        ("results/demo/", "demo"),
        ("latest", "latest"),
    ],
)
def test_a_bare_name_keeps_its_version(path, name):
    assert bare_name(path) == name
