"""Pages: their Python runs, and their commands, options, defaults and file names exist."""

from __future__ import annotations

import builtins
import re
import symtable
from pathlib import Path
from typing import Any

import pytest
import torch

import gs2d
from gs2d.cli.command_line import NAMES, options_of
from gs2d.config.presets import (
    RECIPES,
    with_depth_prior,
    with_exposure,
    with_intrinsics,
    with_normal_prior,
    with_robustness,
)
from gs2d.config.protocols import get_protocol
from gs2d.config.serialize import apply_overrides
from gs2d.errors import RecipeError
from gs2d.pipeline.prepare.open_capture import QUALITIES
from tiny import write_capture

DOCS = Path(__file__).resolve().parents[1] / "docs"
ROOT = DOCS.parent


def run_blocks(page: Path, least: int) -> dict[str, Any]:
    """Run the Python blocks of a page as one program, in the current folder."""
    blocks = list(re.finditer(r"^```python\n(.*?)^```$", page.read_text(encoding="utf-8"), re.M | re.S))
    assert len(blocks) >= least
    names: dict[str, Any] = {}
    for block in blocks:
        lines = block.string[: block.start()].count("\n") + 1
        exec(compile("\n" * lines + block.group(1), str(page), "exec"), names)  # line numbers are those of the page
    return names


def test_the_program_of_the_python_guide_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_capture(tmp_path / "capture")
    run_blocks(DOCS / "guides" / "python.md", 7)
    assert (tmp_path / "runs/mine/mesh.ply").is_file()
    assert (tmp_path / "runs/mine/for_viewers.ply").is_file()


def test_the_program_of_the_migration_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_capture(tmp_path / "capture")
    run_blocks(DOCS / "migration.md", 6)


def test_the_loss_of_the_tutorial_reaches_the_splats_and_its_recipe_trains(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    names = run_blocks(DOCS / "tutorials" / "own-loss.md", 2)
    scene = gs2d.load_scene(write_capture(tmp_path / "capture"))
    plain, crisp = (gs2d.train(scene, one, schedule_scale=0.001) for one in ("best", names["recipe"](weight=5.0)))
    assert not torch.equal(plain.splats.opacity_logits, crisp.splats.opacity_logits)


def test_the_program_of_the_pose_tutorial_recovers_the_cameras() -> None:
    names = run_blocks(DOCS / "tutorials" / "camera-poses.md", 1)
    before, after = names["errors"](names["start"]), names["errors"](names["found"])
    assert before.min() > 0.02
    assert after.max() < 1e-3


@pytest.mark.parametrize("name", ["README.md", "docs/quickstart.md"])
def test_the_first_program_of_a_newcomer_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_capture(tmp_path / "capture")
    text = (ROOT / name).read_text(encoding="utf-8")
    assert "downscale=4), iterations=3000" in text
    page = tmp_path / "page.md"
    page.write_text(text.replace("downscale=4), iterations=3000", "downscale=1), iterations=20"), encoding="utf-8")
    run_blocks(page, 1)
    assert len(gs2d.read_splats(tmp_path / "splats.ply")) > 0


def test_the_programs_of_the_pages_on_scores_and_gpus_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    scene = gs2d.load_scene(write_capture(tmp_path / "capture"))
    write_capture(tmp_path / "data" / "ball")
    run_blocks(DOCS / "guides" / "evaluation.md", 1)
    assert "ball" in capsys.readouterr().out
    (tmp_path / "runs" / "x").mkdir(parents=True)
    gs2d.train(scene, "2dgs", iterations=2).splats.save("runs/x/splats.ply")
    text = (DOCS / "guides" / "gpu.md").read_text(encoding="utf-8")
    for name, instead in {'.to("cuda")': "", "torch.cuda.stream(torch.cuda.Stream())": "torch.enable_grad()"}.items():
        assert name in text  # here, on a CPU, without them
        text = text.replace(name, instead)
    (tmp_path / "gpu.md").write_text(text, encoding="utf-8")
    assert run_blocks(tmp_path / "gpu.md", 1)["output"].color.shape[:2] == scene.train[0].image().shape[:2]


def test_the_recipes_of_the_concepts_page_exist() -> None:
    names = run_blocks(DOCS / "concepts.md", 1)
    assert names["two_dgs_r"].stages == RECIPES["2dgs-r"]().stages


def test_citation_and_changelog_have_the_current_version() -> None:
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    dated = re.search(r"^version: (\S+)\ndate-released: (\S+)$", citation, re.M)
    assert dated is not None
    assert dated[1] == gs2d.__version__
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    released = re.findall(r"^## \[(.*)\] - (.*)$", changelog, re.M)
    assert released[0] == (dated[1], dated[2])
    assert re.findall(r"^## (.*)$", changelog, re.M)[0] == "[Unreleased]"


def free_names(table: symtable.SymbolTable) -> set[str]:
    """Return the names that a block of code uses and does not define."""
    used = {symbol.get_name() for symbol in table.get_symbols() if symbol.is_referenced() and symbol.is_global()}
    if table.get_type() == "module":
        used = {symbol.get_name() for symbol in table.get_symbols() if symbol.is_referenced()}
    used = used.union(*map(free_names, table.get_children()))
    if table.get_type() != "module":
        return used
    made = {one.get_name() for one in table.get_symbols() if one.is_assigned() or one.is_imported()}
    return used - made - set(dir(builtins))


@pytest.mark.parametrize("page", [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))], ids=lambda page: page.stem)
def test_a_python_block_is_complete_or_names_the_blocks_that_it_needs(page: Path) -> None:
    blocks = re.findall(r"^```python\n(.*?)^```$", page.read_text(encoding="utf-8"), re.M | re.S)
    if page.stem == "extending":  # parts of one file, whose imports the page shows first
        return
    free = {block.partition("\n")[0]: free_names(symtable.symtable(block, str(page), "exec")) for block in blocks}
    assert {line: names for line, names in free.items() if names and not line.startswith("# continues ")} == {}


# Options, defaults and files on the user pages are compared with the program. A data file's name is a literal of the
# program but for its EXAMPLES: a name of the user's own, a scene, a number.
DATA = "ply|jsonl?|html|glb|obj|txt|np[yz]|png|tif|log|mat|xml|sfm|sog|spz|usd|webp|xyz|prj"
EXAMPLES = r"\b(?:x|a|b|r_0|mine|stl024|Barn|NAME|VIEW\.KIND)(?![a-z])|24"
NO_USER_PAGES = {"CHANGELOG", "kernels", "math"}
USER_PAGES = [page for folder in ("..", ".", "guides", "tutorials") for page in sorted((DOCS / folder).glob("*.md"))]
USER_PAGES = [page for page in USER_PAGES if page.stem not in NO_USER_PAGES]
OPTIONS = {name: {option.name: option for option in options_of(kind)} for name, kind in NAMES.items()}
ALL_OPTIONS = {flag: option for options in OPTIONS.values() for flag, option in options.items()}
COMMON = {"--help", "--help-all", "--version", "--set"}


def commands_of(text: str) -> list[list[str]]:
    """Return the words of each gs2d command on a page, in blocks of code and between backticks."""
    shell = "".join(re.findall(r"^```sh\n(.*?)^```$", text, re.M | re.S)).replace("\\\n", " ").splitlines()
    spoken = re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```$", "", text, flags=re.M | re.S))
    found = [re.split(r"\s#|\s&&|\||>|\$\(", line)[0].split() for line in [*shell, *spoken]]
    return [words[words.index("gs2d") + 1 :] for words in found if "gs2d" in words and words[-1] != "gs2d"]


@pytest.mark.parametrize("page", USER_PAGES, ids=lambda page: page.stem)
def test_commands_and_options_on_a_page_exist(page: Path) -> None:
    wrong = []
    for name, *words in commands_of(page.read_text(encoding="utf-8")):
        if re.fullmatch(r"[a-z]+", name):
            known = {*OPTIONS.get(name, {}), *COMMON}
            wrong += [] if name in NAMES else [name]
            wrong += [f"{name} {word}" for word in words if word.startswith("--") and word.rstrip(".,") not in known]
    assert not wrong


@pytest.mark.parametrize("page", USER_PAGES, ids=lambda page: page.stem)
def test_options_between_backticks_exist(page: Path) -> None:
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
    named = set(re.findall(r"`(--[a-z][\w-]*)", text))
    foreign = {"--iterations", "--aarch64", "--gpus", "--disable-usage-stats"}  # of other programs
    assert named - ALL_OPTIONS.keys() - COMMON - foreign == set()


@pytest.mark.parametrize("page", USER_PAGES, ids=lambda page: page.stem)
def test_defaults_on_a_page_are_current(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for flag, value in re.findall(r"`(--set \w+|--[\w-]+)[^`]*`(?:[^`(]*\(|, )default:? ([\d.,]*\d|`[\w-]+`)", text):
        assert str(ALL_OPTIONS[flag].default) in (value.strip("`").replace(",", ""), value + ".0"), flag
    for flag, block in re.findall(r"`(--[\w-]+)`[^\n]*\n((?:(?:[-|].*|  .*|)\n)+)", text):
        for value in re.findall(r"^[-|] `([\w-]+)` \(default\)", block, re.M):
            assert ALL_OPTIONS[flag].default in (value, None), flag


def test_defaults_that_no_option_stands_beside_are_current() -> None:
    draft, normal, quantity = QUALITIES["draft"], QUALITIES["normal"], gs2d.Quantity("poses")
    stated = {
        "concepts.md": ["seed 0.", "recipe [`best`]"],
        "migration.md": [f"(near=0.01)` | default {gs2d.RasterSettings().near:g},", "`load_scene(path, test_every=8)`"],
        "extending.md": ["`rate` (default 1e-3) to `rate_final` (1e-5)"],
        "guides/photographs.md": [
            f"{draft['cpu'].iterations} iterations at about {draft['cpu'].side} px",
            f"| {draft['gpu'].iterations} at {draft['gpu'].side} px |",
            f"| `normal` | {normal['cpu'].iterations} at {normal['cpu'].side} px | {normal['gpu'].iterations:,} at",
            f"the default: {RECIPES['best']().iterations:,})",
        ],
    }
    pages = {page: (DOCS / page).read_text(encoding="utf-8") for page in stated}
    assert [text for page, texts in stated.items() for text in texts if text not in pages[page]] == []
    assert (OPTIONS["train"]["--seed"].default, quantity.rate, quantity.rate_final) == (0, 1e-3, 1e-5)
    commands = (DOCS / "guides" / "commands.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (`best`.*|`2dgs.*) \| (\d[\d,; ]+) \|", commands, re.M)
    for names, counts in rows:
        assert counts == "; ".join(f"{RECIPES[name]().iterations:,}" for name in re.findall("`(.+?)`", names))
    assert len(rows) == 3
    assert (gs2d.list_recipes()[0], get_protocol("generic").test_every) == ("best", 8)


def test_files_on_the_pages_exist() -> None:
    written = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "src").rglob("*.py"))
    foreign = {"crisp.py", "metrics.py"}  # of a tutorial, of the official code
    missing = []
    for page in USER_PAGES:
        everything = page.read_text(encoding="utf-8")
        text = re.sub(r"^```.*?^```$", "", everything, flags=re.M | re.S)
        measured = [f"{name.replace('.', '/')}.py" for name in re.findall(r"-m (benchmarks\.\w+)", everything)]
        for path in [*measured, *re.findall(r"`([\w/.-]+\.(?:py|sh|h|toml))(?:`|: )", text)]:
            if path not in foreign and not [
                *ROOT.glob(path),
                *(ROOT / "src").rglob(path),
                *(ROOT / "tests").rglob(path),
            ]:
                missing.append((page.name, path))
        for name in re.findall(rf"`(?:[\w.-]+/)*([\w.-]*\w\.(?:{DATA}))`", text):
            if not (all(part in written for part in re.split(EXAMPLES, name)) or (ROOT / name).is_file()):
                missing.append((page.name, name))
    table = re.findall(
        r"^\| ((?:`[\w./]+`(?:, )?)+) \|", (DOCS / "guides" / "runs.md").read_text(encoding="utf-8"), re.M
    )
    names = re.findall(r"`([\w.]+)/?`", " ".join(table))
    assert len(names) > 15
    assert [name for name in names if f'"{name}"' not in written] == []
    assert missing == []


def test_recipe_fields_on_the_pages_exist() -> None:
    recipes = [RECIPES[name]() for name in ("best", "2dgs-r")]
    recipes.append(with_robustness(with_intrinsics(with_exposure(with_normal_prior(with_depth_prior(recipes[0]))))))
    wrong = []
    for page in USER_PAGES:
        for override in re.findall(r"--set ([a-z0-9_.]+=[\w.]+)", page.read_text(encoding="utf-8")):
            setting = f"--set {override.partition('=')[0]}" in ALL_OPTIONS or override.startswith("partition.")
            if setting or override.endswith(("=N", "=...")) or ".crisp." in override:  # the tutorial's own loss
                continue
            if not any(accepts(recipe, override) for recipe in recipes):
                wrong.append((page.name, override))
    assert not wrong


def accepts(recipe: gs2d.Recipe, override: str) -> bool:
    """Return whether a recipe has the field that an override sets."""
    try:
        apply_overrides(recipe, [override])
    except RecipeError:
        return False
    return True
