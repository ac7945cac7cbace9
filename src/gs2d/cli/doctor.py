"""``gs2d doctor``: what this machine can run, and how to get the rest."""

from __future__ import annotations

from typing import Any

from gs2d.cli import commands as c
from gs2d.cli.console import Console
from gs2d.cli.doctor_extras import OPTIONAL, torch_advice


def doctor(_command: c.Doctor, console: Console) -> None:
    """Look at everything and say what is there."""
    from gs2d.io.run_dir import machine, versions
    from gs2d.render.backends import backend_report

    host, installed, backends = machine(), versions(), backend_report()
    chosen = next((status.name for status in backends if status.available), "none")
    found = {thing.name: thing.look() for thing in OPTIONAL}
    advice = torch_advice()
    console.say(f"{host['processor']}, {host['cores']} cores, {host['system']}")
    console.say(", ".join(f"{name} {version}" for name, version in installed.items()))
    console.heading(f"Rasterizers (--backend auto takes: {chosen})")
    for status in backends:
        _show(console, status.name, status.available, status.details or status.reason, status.remedy)
    if advice:
        console.say(advice, indent="       ")
    console.heading("For some commands")
    for thing in OPTIONAL:
        finding = found[thing.name]
        _show(console, thing.command, finding.available, finding.details, finding.remedy)
    fields = ("name", "available", "reason", "remedy", "details")
    result: dict[str, Any] = {"machine": host, "versions": installed, "auto": chosen, "advice": advice}
    result["backends"] = [{field: getattr(status, field) for field in fields} for status in backends]
    result["extras"] = {name: finding.available for name, finding in found.items()}
    result["optional"] = {name: vars(finding) for name, finding in found.items()}
    console.result(result)


def _show(console: Console, name: str, available: bool, details: str, remedy: str) -> None:
    console.say(f"  {'yes' if available else 'no ':<3}  {name}: {details}", indent="       ")
    if not available and remedy:
        console.say(f"       to get it: {remedy}", indent="         ")
