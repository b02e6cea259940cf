"""Tests and, beside them, what else is checked; one summary and one exit code at the end.

.venv/bin/python scripts/jobs.py [style] [types] [site] [wheel] -- [arguments of pytest]

Tests use all cores and print as they go. The named jobs follow each other beside them; what a job prints is shown where
it failed.
"""

import os
import shlex
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

ROOT = Path(__file__).resolve().parents[1]
PYTHON = shlex.quote(sys.executable)
PROGRAMS = shlex.quote(str(Path(sys.executable).parent))
COMMANDS = {
    "style": f"{PROGRAMS}/ruff check . && {PROGRAMS}/ruff format --check . && {PROGRAMS}/lint-imports",
    "types": f"{PROGRAMS}/pyrefly check --python-interpreter-path {PYTHON} --output-format min-text",
    "site": f"{PYTHON} scripts/build_site.py",
    "wheel": "scripts/try_wheel",
    "tests": f"{PYTHON} -m pytest -n {os.cpu_count() or 1} --dist worksteal",
}


@dataclass
class Job:
    """A command, and once it has ended its exit code, wall and processor seconds."""

    name: str
    command: str
    code: int = -1
    wall_s: float = 0.0
    cpu_s: float = 0.0
    log: IO[bytes] = field(default_factory=tempfile.TemporaryFile)

    def run(self, shown: bool = False) -> None:
        """Run it; what it prints goes into ``log`` unless it is to be shown."""
        start, out = time.monotonic(), None if shown else self.log
        process = subprocess.Popen(["bash", "-c", self.command], cwd=ROOT, stdout=out, stderr=out)
        _, status, used = os.wait4(process.pid, 0)
        self.code = process.returncode = os.waitstatus_to_exitcode(status)
        self.wall_s, self.cpu_s = time.monotonic() - start, used.ru_utime + used.ru_stime

    def summary(self) -> str:
        word = "ok" if self.code == 0 else f"FAILED, exit code {self.code}"
        return f"{self.name:6}  {self.wall_s:5.0f} s, {self.cpu_s:5.0f} s of CPU  {word}"


def main() -> None:
    names = sys.argv[1 : sys.argv.index("--")]
    words = sys.argv[sys.argv.index("--") + 1 :]
    if unknown := set(names) - set(COMMANDS):
        sys.exit(f"no job {', '.join(sorted(unknown))}; one of {', '.join(COMMANDS)} needed")
    beside = [Job(name, COMMANDS[name]) for name in names]
    tests = Job("tests", shlex.join([*shlex.split(COMMANDS["tests"]), *words]))
    start = time.monotonic()
    others = threading.Thread(target=lambda: [job.run() for job in beside])
    others.start()
    tests.run(shown=True)
    others.join()
    for job in beside:
        if job.code:
            job.log.seek(0)
            print(f"\n--- {job.name} ---\n{job.log.read().decode(errors='replace')}", end="")
    jobs = [*beside, tests]
    print("\n" + "\n".join(job.summary() for job in jobs))
    print(f"all     {time.monotonic() - start:5.0f} s, {sum(job.cpu_s for job in jobs):5.0f} s of CPU")
    sys.exit(max(abs(job.code) for job in jobs))


if __name__ == "__main__":
    main()
