"""Completion for bash, zsh and fish: commands, options and values, written from the options that are parsed.

The scripts are static: a press of Tab starts no Python. ``gs2d completion SHELL`` prints one.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from types import MappingProxyType

from gs2d.cli.arguments import NAMES, Option, about, options_of

_LONGEST = 72  # columns of a description beside a word
_PROGRAM = ("--help", "--help-all", "--version")
_COMMAND_HELP = (
    ("--help", "What one needs first of this command."),
    ("--help-all", "Every option of this command."),
)


def script(shell: str) -> str:
    """Return the completion of a shell: "bash", "zsh" or "fish"."""
    return _SCRIPTS[shell]()


def _short(text: str) -> str:
    """Return the first sentence of a text, cut where it is long, without marks."""
    first = re.split(r"(?<=[^.])[.;:](?= |$)", text.replace("`", ""), maxsplit=1)[0]
    return first if len(first) <= _LONGEST else first[: _LONGEST - 3].rsplit(" ", 1)[0] + " ..."


def _flagged(name: str) -> list[Option]:
    return [option for option in options_of(NAMES[name]) if option.flags]


def _first_choices(name: str) -> tuple[str, ...]:
    """Return the values of a command's first argument, where there are only some."""
    return next((option.choices for option in options_of(NAMES[name]) if not option.flags), ())


def _bash() -> str:
    """Options and values by the word before; what is no option is a file."""
    values, options = [], []
    for name in NAMES:
        options.append(f"    {name}) words='{' '.join([f for o in _flagged(name) for f in o.flags] + ['--help'])}'")
        if choices := _first_choices(name):
            options[-1] += f"; [[ $COMP_CWORD == 2 && $now != -* ]] && words='{' '.join(choices)}'"
        options[-1] += " ;;"
        for option in _flagged(name):
            if option.choices:
                patterns = "|".join(f"{name}:{flag}" for flag in option.flags)
                values.append(f"    {patterns}) words='{' '.join(option.choices)}' ;;")
    return "\n".join(
        [
            "# gs2d: completion of bash. In ~/.bashrc: source <(gs2d completion bash)",
            "_gs2d() {",
            "  local now=${COMP_WORDS[COMP_CWORD]} before=${COMP_WORDS[COMP_CWORD-1]} name=${COMP_WORDS[1]} words=",
            "  if [[ $COMP_CWORD == 1 ]]; then",
            f"    COMPREPLY=($(compgen -W '{' '.join([*NAMES, *_PROGRAM])}' -- \"$now\"))",
            "    return",
            "  fi",
            "  case $name:$before in",
            *values,
            "  esac",
            "  [[ -z $words && ( $now == -* || $COMP_CWORD == 2 ) ]] && case $name in",
            *options,
            "  esac",
            "  [[ $words == -* && $now != -* ]] && words=",
            '  COMPREPLY=($(compgen -W "$words" -- "$now"))',
            "}",
            "complete -o default -F _gs2d gs2d",
            "",
        ]
    )


def _zsh() -> str:
    """Options with what they are for; values, else files."""

    def quoted(text: str) -> str:
        return text.replace("'", "'\\''")

    def spec(option: Option) -> list[str]:
        said = re.sub(r"([\[\]:\\])", r"\\\1", _short(option.about))
        value = f"({' '.join(option.choices)})" if option.choices else "_files"
        takes = "" if option.kind is bool else f":{option.metavar.partition(' ')[0].replace(':', '')}:{value}"
        return [f"      '{quoted(f'*{flag}[{said}]{takes}')}'" for flag in option.flags]

    lines = [
        "#compdef gs2d",
        '# gs2d: completion of zsh. As _gs2d in a folder of $fpath, or: eval "$(gs2d completion zsh)"',
    ]
    lines += ["_gs2d() {", "  local -a commands", "  commands=("]
    lines += [f"    '{quoted(name + ':' + _short(about(command)))}'" for name, command in NAMES.items()]
    lines += ["  )", "  if (( CURRENT == 2 )); then", "    _describe command commands", "    return", "  fi"]
    lines += ["  local name=$words[2]", "  shift words", "  (( CURRENT-- ))", "  case $name in"]
    for name in NAMES:
        first = f"({' '.join(choices)})" if (choices := _first_choices(name)) else "_files"
        lines += [f"    {name}) _arguments \\"]
        lines += [f"{line} \\" for option in _flagged(name) for line in spec(option)]
        lines += [f"      '{flag}[{said}]' \\" for flag, said in _COMMAND_HELP]
        lines += [f"      '1:argument:{first}' '*:file:_files' ;;"]
    lines += ["  esac", "}", 'if [[ $funcstack[1] == _gs2d ]]; then _gs2d "$@"; else compdef _gs2d gs2d; fi', ""]
    return "\n".join(lines)


def _fish() -> str:
    """One line an option, with what it is for."""

    def quoted(text: str) -> str:
        return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"

    lines = ["# gs2d: completion of fish. gs2d completion fish > ~/.config/fish/completions/gs2d.fish"]
    for name, command in NAMES.items():
        lines.append(f"complete -c gs2d -n __fish_use_subcommand -f -a {name} -d {quoted(_short(about(command)))}")
    lines += [f"complete -c gs2d -n __fish_use_subcommand -l {flag[2:]}" for flag in _PROGRAM]
    for name in NAMES:
        begin = f"complete -c gs2d -n '__fish_seen_subcommand_from {name}'"
        if choices := _first_choices(name):
            lines.append(f"{begin} -f -a {quoted(' '.join(choices))}")
        for option in _flagged(name):
            takes = (
                "" if option.kind is bool else f" -x -a {quoted(' '.join(option.choices))}" if option.choices else " -r"
            )
            for flag in option.flags:
                kind = f"-l {flag[2:]}" if flag.startswith("--") else f"-s {flag[1:]}"
                lines.append(f"{begin} {kind}{takes} -d {quoted(_short(option.about))}")
        lines += [f"{begin} -l {flag[2:]} -d {quoted(said)}" for flag, said in _COMMAND_HELP]
    return "\n".join([*lines, ""])


_SCRIPTS: Mapping[str, Callable[[], str]] = MappingProxyType({"bash": _bash, "zsh": _zsh, "fish": _fish})
SHELLS = tuple(_SCRIPTS)
