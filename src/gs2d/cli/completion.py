"""Shell completion of commands, options and values, generated from the options that are parsed.

The scripts are static, so that a press of Tab starts no Python. ``gs2d completion SHELL`` prints one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

from gs2d.cli.arguments import NAMES, about, options_of

_PROGRAM = ("--help", "--help-all", "--version")
_BASH = """_gs2d() {{
  local now=${{COMP_WORDS[COMP_CWORD]}} before=${{COMP_WORDS[COMP_CWORD-1]}} name=${{COMP_WORDS[1]}} words=
  if [[ $COMP_CWORD == 1 ]]; then words='{names}'
  else
    case $name:$before in
{values}
    esac
    [[ -z $words && $now == -* ]] && case $name in
{options}
    esac
  fi
  COMPREPLY=($(compgen -W "$words" -- "$now"))
}}
complete -o default -F _gs2d gs2d
"""


def script(shell: str) -> str:
    """Return the completion script of a shell: "bash", "zsh" or "fish"."""
    return _SCRIPTS[shell]()


def _words(name: str) -> list[str]:
    """Return the options of a command."""
    return [*(flag for option in options_of(NAMES[name]) for flag in option.flags), "--help", "--help-all"]


def _values() -> list[tuple[str, str, tuple[str, ...]]]:
    """Return command, preceding word and possible values, for options and arguments with fixed values."""
    return [
        (name, flag, option.choices)
        for name in NAMES
        for option in options_of(NAMES[name])
        if option.choices
        for flag in option.flags or (name,)
    ]


def _functions() -> str:
    return _BASH.format(
        names=" ".join([*NAMES, *_PROGRAM]),
        values="\n".join(f"    {name}:{before}) words='{' '.join(words)}' ;;" for name, before, words in _values()),
        options="\n".join(f"    {name}) words='{' '.join(_words(name))}' ;;" for name in NAMES),
    )


def _bash() -> str:
    return "# In ~/.bashrc: source <(gs2d completion bash)\n" + _functions()


def _zsh() -> str:
    return '# In ~/.zshrc: eval "$(gs2d completion zsh)"\nautoload -U +X bashcompinit && bashcompinit\n' + _functions()


def _fish() -> str:
    lines = ["# gs2d completion fish > ~/.config/fish/completions/gs2d.fish"]
    for name, command in NAMES.items():
        text = about(command).replace("`", "").replace("'", "\\'")
        lines.append(f"complete -c gs2d -n __fish_use_subcommand -f -a {name} -d '{text}'")
        flags = [word[2:] for word in _words(name) if word.startswith("--")]
        lines += [f"complete -c gs2d -n '__fish_seen_subcommand_from {name}' -l {flag}" for flag in flags]
    lines += [f"complete -c gs2d -n __fish_use_subcommand -l {flag[2:]}" for flag in _PROGRAM]
    for name, before, words in _values():
        option = f" -l {before[2:]} -x" if before.startswith("--") else " -f"
        lines.append(f"complete -c gs2d -n '__fish_seen_subcommand_from {name}'{option} -a '{' '.join(words)}'")
    return "\n".join([*lines, ""])


_SCRIPTS: Mapping[str, Callable[[], str]] = MappingProxyType({"bash": _bash, "zsh": _zsh, "fish": _fish})
SHELLS = tuple(_SCRIPTS)
