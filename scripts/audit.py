"""Check the dependencies' licences by metadata and known vulnerabilities with pip-audit (`make audit`).

Exit codes: 0 without findings, 1 with findings, 3 if pip-audit is not installed or cannot reach its database. Licences
are checked in any case.
"""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOUND, NOT_CHECKED = 1, 3


def licences() -> int:
    """Run the test that checks licences against the allowed list; return 0 if all pass."""
    words = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        str(ROOT / "tests" / "test_dependencies.py"),
    ]
    done = subprocess.run(words, capture_output=True, text=True, check=False, cwd=ROOT)
    print(f"licences: {done.stdout.strip().splitlines()[-1] if done.stdout.strip() else done.stderr.strip()}")
    return FOUND if done.returncode else 0


def vulnerabilities(requirements: Path) -> int:
    """Check the pinned versions with pip-audit; print a message if the check is not possible."""
    if importlib.util.find_spec("pip_audit") is None:
        print(f"vulnerabilities: not checked, pip-audit is not installed; {sys.executable} -m pip install pip-audit")
        return NOT_CHECKED
    words = [sys.executable, "-m", "pip_audit", "--no-deps", "--disable-pip", "-f", "json", "-r", str(requirements)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    try:
        audited = json.loads(done.stdout)["dependencies"]
    except (ValueError, KeyError, TypeError):
        why = (done.stderr.strip().splitlines() or ["no answer"])[-1]
        print(f"vulnerabilities: not checked, the database could not be asked: {why[:200]}")
        return NOT_CHECKED
    known = [(package, fault) for package in audited for fault in package.get("vulns", ())]
    skipped = [package["name"] for package in audited if "skip_reason" in package]
    for package, fault in known:
        fixed = ", ".join(fault["fix_versions"]) or "no version yet"
        print(f"vulnerability: {package['name']} {package['version']}: {fault['id']}; fixed in {fixed}")
    print(f"vulnerabilities: {len(known)} known in {len(audited) - len(skipped)} packages of {requirements.name}")
    if skipped:
        print(f"vulnerabilities: not checked: {', '.join(skipped)}")
    return FOUND if known else NOT_CHECKED if skipped else 0


if __name__ == "__main__":
    results = (licences(), vulnerabilities(ROOT / "constraints.txt"))
    sys.exit(FOUND if FOUND in results else max(results))
