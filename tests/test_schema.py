"""Tables of TOML files: each kind of value at the ends of its range, messages, suggestions, and limits of a file."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from gpuvision.schema import DescriptionError, Section, preset_names, read_preset, read_toml

LARGEST_INTEGER = 2**31 - 1


def section(name: str = "part", **values: Any) -> Section:
    return Section(values, "file.toml", name)


def refused(make: Callable[[], Any], message: str) -> None:
    """Check that a call fails with exactly this message."""
    with pytest.raises(DescriptionError) as caught:
        make()
    assert str(caught.value) == f"file.toml: {message}"


LIMITS = {"above": 1.0, "at_least": 1.5, "below": 9.0, "at_most": 8.5}
WORDS = {"above": "above 1", "at_least": "of at least 1.5", "below": "below 9", "at_most": "of at most 8.5"}


@pytest.mark.parametrize(("limit", "last", "first"), [
    ("above", math.nextafter(1.0, 2.0), 1.0),
    ("at_least", 1.5, math.nextafter(1.5, 0.0)),
    ("below", math.nextafter(9.0, 0.0), 9.0),
    ("at_most", 8.5, math.nextafter(8.5, 9.0)),
])  # fmt: skip
def test_ends_of_a_range(limit: str, last: float, first: float) -> None:
    """The last accepted and the first refused number of each limit; the message states the range."""
    given = {limit: LIMITS[limit]}
    assert section(a=last).number("a", "m", **given) == last
    refused(
        lambda: section(a=first).number("a", "m", **given), f"part.a is {first} m, expected a number [m] {WORDS[limit]}"
    )
    refused(lambda: section(a=first).number("a", "", **given), f"part.a is {first}, expected a number {WORDS[limit]}")
    whole = {"above": 3.0, "at_least": 4.0, "below": 5.0, "at_most": 4.0}[limit]
    assert section(a=4).integer("a", **{limit: whole}) == 4
    beyond = 3 if limit in ("above", "at_least") else 5
    with pytest.raises(DescriptionError, match=rf"part\.a is {beyond}, expected a whole number (above|of|below)"):
        section(a=beyond).integer("a", **{limit: whole})


def test_two_limits() -> None:
    both = {"above": 0.0, "at_most": 1.0}
    assert section(a=1).number("a", "m", **both) == 1.0
    for value in (0, 1.5):
        refused(
            lambda value=value: section(a=value).number("a", "m", **both),
            f"part.a is {value} m, expected a number [m] above 0 and of at most 1",
        )
    refused(
        lambda: section(a=0).integer("a", at_least=1, at_most=9),
        "part.a is 0, expected a whole number of at least 1 and of at most 9",
    )


@pytest.mark.parametrize("value", [True, False, "1", None, math.nan, math.inf, -math.inf, [1.0], {"b": 1}])
def test_what_is_no_number(value: Any) -> None:
    unit = " m" if isinstance(value, float) else ""
    refused(lambda: section(a=value).number("a", "m"), f"part.a is {value!r}{unit}, expected a number [m]")
    refused(lambda: section(a=value).integer("a"), f"part.a is {value!r}, expected a whole number")
    refused(lambda: section(a=1.0).integer("a"), "part.a is 1.0, expected a whole number")


@pytest.mark.parametrize(
    ("unit", "largest"), [("m", 1e6), ("m per profile", 1e3), ("pixel", 1e6), ("", 1e20), ("s", 1e20)]
)
def test_largest_numbers(unit: str, largest: float) -> None:
    for sign in (1.0, -1.0):
        assert section(a=sign * largest).number("a", unit) == sign * largest
        with pytest.raises(DescriptionError, match=re.escape(f"expected a size of at most {largest:g}")):
            section(a=sign * math.nextafter(largest, math.inf)).number("a", unit)
    for sign in (1, -1):
        assert section(a=sign * LARGEST_INTEGER).integer("a") == sign * LARGEST_INTEGER
        refused(
            lambda sign=sign: section(a=sign * 2**31).integer("a"),
            f"part.a is {sign * 2**31}, expected a whole number of at most {LARGEST_INTEGER}",
        )
    with pytest.raises(
        DescriptionError, match=r"part\.a is a number of 20001 bits, expected a whole number of at most"
    ):
        section(a=1 << 20000).integer("a")


def test_types_and_defaults() -> None:
    found = section(a=3, b=4.0).number("a", "m")
    assert (found, type(found)) == (3.0, float)
    for default in (None, 2.5):
        assert section().number("a", "m", default) is default
    assert section().integer("a", None) is None
    assert section().integer("a", 7) == 7
    assert section().numbers("a", "m", (2,), (1.0, 2.0)) == (1.0, 2.0)
    assert section().numbers("a", "m", (2,), None) is None
    assert section().rows("a", "m", 3, None) is None
    assert section().choice("a", ("x", "y"), "y") == "y"
    assert section().choice("a", ("x", "y"), None) is None
    assert section().text("a", "b") == "b"
    assert section().text("a", None) is None
    assert section().word("a", ("x",)) is None
    assert section().sections("a") == ()
    assert section().optional_section("a") is None


def test_lists_of_numbers() -> None:
    assert section(a=[1, 2.5]).numbers("a", "m", (2, 3)) == (1.0, 2.5)
    assert section(a=[1, 2.5, -3]).numbers("a", "m", (2, 3)) == (1.0, 2.5, -3.0)
    for value in ([1.0], [1.0] * 4, 1.0, "12"):
        refused(
            lambda value=value: section(a=value).numbers("a", "m", (2, 3)),
            f"part.a is {value!r}, expected a list of 2 or 3 numbers [m]",
        )
    refused(lambda: section(a=[1.0]).numbers("a", "", (2,)), "part.a is [1.0], expected a list of 2 numbers")
    refused(lambda: section(a=[1.0, True]).numbers("a", "m", (2,)), "part.a is True, expected a number [m]")
    refused(
        lambda: section(a=[1.0, 2e6]).numbers("a", "m", (2,)), "part.a is 2000000.0 m, expected a size of at most 1e+06"
    )


def test_rows_of_numbers() -> None:
    assert section(a=[[1, 2], [3, 4]]).rows("a", "m", 2) == ((1.0, 2.0), (3.0, 4.0))
    assert section(a=[[1], [3, 4]]).rows("a", "m") == ((1.0,), (3.0, 4.0))
    for value in ([], [[]], [[1.0], []], [1.0], 1.0, [[1.0, 2.0], 3.0]):
        refused(
            lambda value=value: section(a=value).rows("a", "m"),
            f"part.a is {value!r}, expected a list of rows of numbers [m]",
        )
    for value in ([[1.0]], [[1.0, 2.0], [3.0]], [[1.0, 2.0, 3.0]]):
        refused(
            lambda value=value: section(a=value).rows("a", "", 2),
            f"part.a is {value!r}, expected a list of rows of 2 numbers",
        )
    refused(lambda: section(a=[[1.0, "2"]]).rows("a", "m", 2), "part.a is '2', expected a number [m]")


def test_words_and_texts(tmp_path: Path) -> None:
    assert section(a="red").choice("a", ("green", "red")) == "red"
    refused(
        lambda: section(a="rad").choice("a", ("green", "red")),
        'part.a is \'rad\', expected one of "green", "red" (did you mean "red"?)',
    )
    refused(lambda: section(a=3).choice("a", ("green", "red")), 'part.a is 3, expected one of "green", "red"')
    assert section(a="x").text("a") == "x"
    refused(lambda: section(a=1.5).text("a"), "part.a is 1.5, expected text")
    assert section(a="red").word("a", ("green", "red")) == "red"
    for value in ("blue", 3, None, ["red"]):
        assert section(a=value).word("a", ("green", "red")) is None
    top = Section({"a": "b.toml", "c": {"d": "/e"}}, "file.toml", folder=tmp_path)
    assert top.files == ()
    assert top.file("a") == tmp_path / "b.toml"
    assert top.section("c").file("d") == Path("/e")
    assert top.files == (tmp_path / "b.toml", Path("/e"))
    for name in ("", "a\0b"):
        with pytest.raises(DescriptionError, match="expected the name of a file"):
            section(a=name).file("a")


def test_tables_and_their_names() -> None:
    top = Section({"a": {"b": {"c": 1}}, "d": [{"e": 2}, {"e": 3}], "f": 4}, "file.toml")
    inner = top.section("a").section("b")
    assert (top.name, inner.name, inner.dotted("c"), top.dotted("c")) == ("", "a.b", "a.b.c", "c")
    assert ("c" in inner, "x" in inner) == (True, False)
    assert [(each.name, each.integer("e")) for each in top.sections("d")] == [("d[0]", 2), ("d[1]", 3)]
    found = top.optional_section("a")
    assert found is not None
    copied = top.to_dict()
    copied["a"]["b"]["c"] = 9
    assert inner.integer("c") == 1
    refused(lambda: top.section("f"), "f is 4, expected a table [f]")
    refused(lambda: top.section("a").section("x"), "the key 'a.x' is missing, expected a table")
    for value in (3, {"e": 1}, [{"e": 1}, 2]):
        refused(lambda value=value: section(a=value).sections("a"), f"part.a is {value!r}, expected tables [[part.a]]")


def test_missing_and_unknown_keys() -> None:
    refused(
        lambda: section().number("width", "m", above=0.0),
        "the key 'part.width' is missing, expected a number [m] above 0",
    )
    refused(
        lambda: section(widht=1.0).number("width", "m"),
        "the key 'part.width' is missing, expected a number [m] (is it 'part.widht'?)",
    )
    queried = section(widths=1.0, width=2.0)
    queried.number("widths", "m")
    queried.number("width", "m")
    queried.finish()
    refused(lambda: queried.number("widthz", "m"), "the key 'part.widthz' is missing, expected a number [m]")
    misspelt = section(colour=1.0, width=2.0)
    misspelt.number("width", "m")
    refused(misspelt.finish, "unknown key 'part.colour'; known: width")
    misspelt.text("color", None)
    misspelt.text("color", None)
    refused(misspelt.finish, "unknown key 'part.colour'; did you mean 'part.color'?")
    refused(section(zzz=1).finish, "unknown key 'part.zzz'; known: none")
    other = section(zzz=1)
    for key in ("a", "b", "a"):
        other.number(key, "", None)
    refused(other.finish, "unknown key 'part.zzz'; known: a, b")


def test_long_values_are_cut() -> None:
    """A value of up to 60 characters is shown as a whole, a longer one by its first 56."""
    for length, shown in ((58, "'" + 58 * "x" + "'"), (59, "'" + 55 * "x" + " ...")):
        refused(
            lambda length=length: section(a=length * "x").number("a", "m"), f"part.a is {shown}, expected a number [m]"
        )
    with pytest.raises(DescriptionError) as caught:
        Section({99 * "k": 1}, "file.toml").finish()
    assert str(caught.value) == f"file.toml: unknown key '{56 * 'k'} ...'; known: none"


@pytest.mark.parametrize("name", ["part", ""])
def test_errors_of_classes_name_the_table(name: str) -> None:
    place = "part: " if name else ""
    for error in (ValueError("wrong"), TypeError("wrong"), ZeroDivisionError("wrong"), OverflowError("wrong")):
        with pytest.raises(DescriptionError) as caught, section(name).checking():
            raise error
        assert str(caught.value) == f"file.toml: {place}wrong"
    own = DescriptionError("as it is")
    with pytest.raises(DescriptionError) as caught, section(name).checking():
        raise own
    assert caught.value is own
    with pytest.raises(KeyError), section(name).checking():
        raise KeyError("other")


# ---- files -------------------------------------------------------------------------------------------------------


def read(folder: Path, text: str) -> Section:
    path = folder / "a.toml"
    path.write_bytes(text.encode())
    return read_toml(path)


@pytest.mark.parametrize(("opening", "closing"), [("[", "]"), ("{a = ", "}")])
def test_depth_of_a_file(tmp_path: Path, opening: str, closing: str) -> None:
    """32 nested arrays or tables, or parts of a key, are accepted."""
    assert "x" in read(tmp_path, f"x = {32 * opening}1{32 * closing}\n")
    with pytest.raises(DescriptionError, match=r"a\.toml: nested 33 deep, expected at most 32"):
        read(tmp_path, f"x = {33 * opening}1{33 * closing}\n")
    # Side by side they do not add up.
    assert "x" in read(
        tmp_path, f"x = [{', '.join(30 * [f'{opening}1{closing}'])}]\ny = {31 * opening}1{31 * closing}\n"
    )


def test_parts_of_a_key(tmp_path: Path) -> None:
    for key in (".".join(32 * ["k"]), ".".join(32 * ['"a.b"']), ".".join(32 * ["'c.d'"])):
        assert len(read(tmp_path, f"{key} = 1\n").to_dict()) == 1
        with pytest.raises(DescriptionError, match=r"a\.toml: a key of 33 parts, expected at most 32"):
            read(tmp_path, f"{key}.k = 1\n")
    many = "\n".join(f"a{number}.b = 1.5" for number in range(40))
    assert len(read(tmp_path, many).to_dict()) == 40


def test_brackets_in_texts_and_comments_do_not_count(tmp_path: Path) -> None:
    brackets, dots = 40 * "[", ".".join(40 * ["k"])
    texts = [
        f'"{brackets}"',
        f"'{dots}'",
        f'"""\n{brackets}\n"\\" {dots}"""',
        f"'''\n{dots}\n''{brackets}'''",
        f'"\\"{brackets}"',
    ]
    for text in texts:
        assert brackets in read(tmp_path, f"x = {text}\n").text("x") or dots in read(tmp_path, f"x = {text}\n").text(
            "x"
        )
    assert read(tmp_path, f"x = 1  # {brackets} {dots}\n").integer("x") == 1


def test_size_and_content_of_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GPUVISION_MAX_DESCRIPTION_BYTES", "20")
    assert read(tmp_path, "x = 1  # " + 11 * "c").integer("x") == 1
    with pytest.raises(DescriptionError, match=r"a\.toml: 21 bytes, expected at most 20"):
        read(tmp_path, "x = 1  # " + 12 * "c")
    monkeypatch.delenv("GPUVISION_MAX_DESCRIPTION_BYTES")
    with pytest.raises(DescriptionError, match=r"a\.toml: not valid TOML: .*line 2"):
        read(tmp_path, "x = 1\ny\n")
    (tmp_path / "b.toml").write_bytes(b"\xff")
    with pytest.raises(DescriptionError, match=r"b\.toml: not valid TOML: 'utf-8'"):
        read_toml(tmp_path / "b.toml")
    with pytest.raises(IsADirectoryError, match="a folder, expected a TOML file"):
        read_toml(tmp_path)
    assert read(tmp_path, 'x = "y.toml"').file("x") == tmp_path / "y.toml"


def test_presets_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = preset_names("cameras")
    assert names == ("lupa300", "pb1024")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lupa300").write_text("x = 1\n")
    assert "x" not in read_preset("lupa300", "cameras", "image sensor")
    assert read_preset("./lupa300", "cameras", "image sensor").integer("x") == 1
    with pytest.raises(DescriptionError, match=r"^preset lupa300: "):
        read_preset("lupa300", "cameras", "image sensor").number("y", "m")
    with pytest.raises(FileNotFoundError, match=r"^there is no image sensor file lupa3000; did you mean 'lupa300'\?$"):
        read_preset("lupa3000", "cameras", "image sensor")
    with pytest.raises(
        FileNotFoundError, match=r"^there is no image sensor file x\.toml; give a file or one of lupa300, pb1024$"
    ):
        read_preset(Path("x.toml"), "cameras", "image sensor")
