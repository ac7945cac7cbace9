"""Completion in the shells themselves, and one meaning for each option."""

from __future__ import annotations

import shutil
import subprocess
from collections import defaultdict
from pathlib import Path

import pytest

from gs2d.cli import run
from gs2d.cli.arguments import NAMES, Option, options_of
from gs2d.cli.completion import SHELLS, script


def uses() -> dict[str, list[tuple[str, Option]]]:
    """Return, by flag, the commands that have it."""
    found: dict[str, list[tuple[str, Option]]] = defaultdict(list)
    for name, command in NAMES.items():
        for option in options_of(command):
            for flag in option.flags:
                found[flag].append((name, option))
    return found


def test_an_option_takes_the_same_values_in_every_command() -> None:
    for flag, having in uses().items():
        kinds = {(option.kind, option.count, option.choices, option.flags) for _, option in having}
        assert len(kinds) == 1, f"{flag}: {[name for name, _ in having]}"
        assert len({option.field for _, option in having}) == 1, flag


def bash(*words: str) -> list[str]:
    """Return what bash proposes for the last word."""
    code = script("bash") + f"COMP_WORDS=({' '.join(map(repr, words))}); COMP_CWORD={len(words) - 1}; _gs2d\n"
    code += 'printf "%s\\n" "${COMPREPLY[@]}"'
    done = subprocess.run(["bash", "--norc", "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    return done.stdout.split()


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
def test_bash_completes_commands_options_and_values() -> None:
    assert set(bash("gs2d", "re")) == {name for name in NAMES if name.startswith("re")}
    assert set(bash("gs2d", "")) == {*NAMES, "--help", "--help-all", "--version"}
    assert bash("gs2d", "train", "here", "--over") == ["--overwrite"]
    assert bash("gs2d", "train", "here", "--no-p") == ["--no-page"]
    assert bash("gs2d", "reconstruct", "here", "--quality", "") == ["draft", "normal", "full"]
    assert bash("gs2d", "reconstruct", "here", "--quality", "d") == ["draft"]
    assert bash("gs2d", "completion", "f") == ["fish"]
    assert bash("gs2d", "train", "here", "--out", "") == []  # files, by bash itself
    assert bash("gs2d", "mesh", "--quality", "") == []  # of another command


@pytest.mark.skipif(shutil.which("fish") is None, reason="fish is not installed")
def test_fish_completes_commands_options_and_values(tmp_path: Path) -> None:
    (tmp_path / "gs2d.fish").write_text(script("fish"))

    def proposed(line: str) -> list[str]:
        code = f"source {tmp_path}/gs2d.fish; complete -C '{line}'"
        done = subprocess.run(
            ["fish", "--no-config", "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path
        )
        assert done.stderr == ""
        return [proposal.partition("\t")[0] for proposal in done.stdout.splitlines()]

    assert set(proposed("gs2d re")) == {name for name in NAMES if name.startswith("re")}
    assert proposed("gs2d train here --over") == ["--overwrite"]
    assert set(proposed("gs2d reconstruct here --quality ")) == {"draft", "normal", "full"}
    assert set(proposed("gs2d completion ")) == set(SHELLS)
    assert "gs2d.fish" in proposed("gs2d train ")


@pytest.mark.skipif(shutil.which("zsh") is None, reason="zsh is not installed")
def test_zsh_takes_the_script_of_bash(tmp_path: Path) -> None:
    (tmp_path / "_gs2d").write_text(script("zsh"))
    code = f"""
    autoload -U compinit && compinit -u -d {tmp_path}/dump; source {tmp_path}/_gs2d
    COMP_WORDS=(gs2d recon); COMP_CWORD=1; setopt ksharrays shwordsplit; _gs2d; print -l "${{COMPREPLY[@]}}"
    """
    done = subprocess.run(["zsh", "-f", "-c", code], capture_output=True, text=True, check=True)
    assert "reconstruct" in done.stdout.split()


@pytest.mark.parametrize("shell", SHELLS)
def test_the_command_prints_the_script_and_nothing_else(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["completion", shell]) == 0
    out, err = capsys.readouterr()
    assert out == script(shell)
    assert err == ""
    assert "`" not in out
