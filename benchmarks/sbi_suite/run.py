"""Run sbi's own tests with NPE_C and with ASBI in its place, and compare.

    python -m pip install pyro-ppl pymc pytest-harvest pytest-mock torchtestcase
    python -m benchmarks sbi_suite

The tests come from the source distribution of the sbi that is installed, fetched by
pip. Every test file that touches NPE_C runs, without those marked slow, gpu or mcmc.
Writes result.json beside this file: the outcome of every test that differs, and counts.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from benchmarks.rows import recorded

HERE = Path(__file__).parent
USES_NPE = re.compile(r"\b(NPE_C|NPE|SNPE|SNPE_C)\b")


def fetch_tests(folder: Path) -> Path:
    """Return the root of sbi's source distribution."""
    command = [sys.executable, "-m", "pip", "download", "--no-deps", "--no-binary"]
    command += ["sbi", "--dest", str(folder), f"sbi=={version('sbi')}"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    archive = next(folder.glob("sbi-*.tar.gz"))
    with tarfile.open(archive) as tar:
        tar.extractall(folder, filter="data")
    root = folder / archive.name.removesuffix(".tar.gz")
    shutil.rmtree(root / "sbi")  # the installed package is the one under test
    return root


def run_tests(root: Path, files: Sequence[str], *, swap: bool) -> dict[str, str]:
    """Return the outcome of every test by its name."""
    report = root / f"report_{'swapped' if swap else 'original'}.xml"
    command = [sys.executable, "-m", "pytest", "-q", *files, f"--junitxml={report}"]
    command += ["-m", "not slow and not gpu and not mcmc", "-p", "no:cacheprovider"]
    command += ["-p", "swap"] if swap else []
    paths = os.pathsep.join([str(HERE), os.environ.get("PYTHONPATH", "")])
    env = os.environ | {"PYTHONPATH": paths, "OMP_NUM_THREADS": "1"}
    subprocess.run(command, cwd=root, env=env)
    outcomes = {}
    for case in ET.parse(report).iter("testcase"):
        kinds = {child.tag for child in case} & {"failure", "error", "skipped"}
        name = f"{case.get('classname')}::{case.get('name')}"
        outcomes[name] = next(iter(kinds), "passed")
    return outcomes


def main() -> None:
    """Run all with and without the class swapped, and print what differs."""
    with tempfile.TemporaryDirectory() as folder:
        root = fetch_tests(Path(folder))
        every = sorted((root / "tests").glob("*_test.py"))
        chosen = [
            f"tests/{path.name}"
            for path in every
            if USES_NPE.search(path.read_text()) and path.name != "tutorials_test.py"
        ]
        original = run_tests(root, chosen, swap=False)
        swapped = run_tests(root, chosen, swap=True)
    differ = {
        name: [original.get(name, "absent"), swapped.get(name, "absent")]
        for name in sorted(original.keys() | swapped.keys())
        if original.get(name) != swapped.get(name)
    }
    found = {
        "sbi": version("sbi"),
        "original": Counter(original.values()),
        "swapped": Counter(swapped.values()),
        "differ": differ,
    }
    recorded(HERE / "result.json", "sbi_suite", files=[*chosen], **found)
    print(json.dumps(found, indent=2))
    sys.exit(bool(differ))
