"""Names that stand for things: what is there, what is refused, and packages that cannot be imported."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import pytest

from gs2d.config.registry import Registry, origin_of
from gs2d.errors import PluginWarning, RecipeError
from gs2d.pipeline.attempts import reason_of


def offer(folder: Path, package: str, entries: str, code: str) -> None:
    """A package as pip would install it: a module, and what its metadata says."""
    module = package.replace("-", "_")
    (folder / f"{module}.py").write_text(code)
    info = folder / f"{module}-1.5.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.5\n")
    (info / "entry_points.txt").write_text(f"[gs2d.tests]\n{entries}\n")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


def registry() -> Registry[str]:
    made: Registry[str] = Registry("dish", "gs2d.tests", builtin={"soup": "gs2d.errors"}, error=RecipeError)
    made._objects["soup"] = "hot"
    return made


def test_what_a_package_offers_is_imported_when_it_is_asked_for(folder: Path) -> None:
    offer(folder, "late-guest", "stew = late_guest:STEW", "STEW = 'thick'")
    dishes = registry()
    assert dishes.names() == ("soup", "stew")
    assert dishes.guests() == ("stew",)
    assert "stew" in dishes
    assert "late_guest" not in sys.modules
    assert dishes.get("stew") == "thick"
    assert dishes.source("stew") == "late-guest 1.5"
    assert dishes.source("soup") == "gs2d"


def test_an_unknown_name_says_what_there_is_and_what_was_meant() -> None:
    with pytest.raises(RecipeError, match="soup"):
        registry().get("soop")


def test_a_name_is_given_once() -> None:
    dishes = registry()
    dishes.register("stew")(folded := lambda: None)
    dishes.register("stew")(folded)  # the same once more: a module that was imported twice
    with pytest.raises(RecipeError, match="test_registry"):
        dishes.register("stew")(lambda: 1)
    with pytest.raises(RecipeError, match="dish"):
        dishes.register("soup")(lambda: 1)


def test_a_package_that_cannot_be_imported_is_one_line_and_stops_only_who_asks_for_it(folder: Path) -> None:
    offer(folder, "sour-guest", "stew = sour_guest:STEW", "import nothing_of_this_name")
    offer(folder, "sweet-guest", "cake = sweet_guest:CAKE", "CAKE = 'moist'")
    dishes = registry()
    with pytest.raises(RecipeError, match="sour_guest"):
        dishes.get("stew")
    with pytest.warns(PluginWarning, match="sour-guest 1.5 cannot be imported") as seen:
        assert dict(dishes.working()) == {"soup": "hot", "cake": "moist"}
    assert len(seen) == 1
    assert "\n" not in str(seen[0].message)


def test_of_a_name_that_is_taken_the_first_keeps_it_and_one_line_says_so(folder: Path) -> None:
    offer(folder, "a-guest", "stew = a_guest:STEW", "STEW = 'of a'")
    offer(folder, "b-guest", "stew = b_guest:STEW\nsoup = b_guest:STEW", "STEW = 'of b'")
    dishes = registry()
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        assert dishes.get("stew") == "of a"
        assert dishes.get("soup") == "hot"
    assert sorted(str(warning.message) for warning in seen) == [
        "b-guest 1.5 declares the dish 'soup' of gs2d; it is ignored",
        "b-guest 1.5 declares the dish 'stew' of a-guest 1.5; it is ignored",
    ]


def test_an_error_out_of_a_package_names_the_package(folder: Path) -> None:
    code = "class Stew:\n    def cook(self):\n        return 1 / 0\nclass Other(Stew): ...\n"
    offer(folder, "burnt-guest", "other = burnt_guest:Other\nstew = burnt_guest:Stew", code)
    dishes: Registry[type] = registry()  # type: ignore[assignment]
    with pytest.raises(ZeroDivisionError) as raised:
        (dishes.get("other"), dishes.get("stew"))[1]().cook()
    assert origin_of(raised.value) == "dish 'stew' of burnt-guest 1.5"
    assert reason_of(raised.value).startswith("fault in dish 'stew' of burnt-guest 1.5: ZeroDivisionError")
    with pytest.raises(RecipeError) as ours:
        dishes.get("soop")
    assert origin_of(ours.value) == "gs2d"
