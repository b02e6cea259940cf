"""Progress of long work: a bar on a terminal, plain lines otherwise; on standard error."""

import sys
import time

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

LINE_EVERY_S = 5.0


class StageProgress:
    """A callable (stage, done, total) for the pipeline; use as a context manager."""

    def __init__(self):
        self.bar = None
        self.tasks: dict[str, int] = {}
        self.last = 0.0
        if sys.stderr.isatty():
            columns = (TextColumn("{task.description:<10}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
            self.bar = Progress(*columns, console=Console(stderr=True))

    def __enter__(self) -> "StageProgress":
        if self.bar:
            self.bar.start()
        return self

    def __exit__(self, *_) -> None:
        if self.bar:
            self.bar.stop()

    def __call__(self, stage: str, done: int, total: int) -> None:
        if self.bar:
            if stage not in self.tasks:
                self.tasks[stage] = self.bar.add_task(stage, total=total)
            self.bar.update(self.tasks[stage], completed=done, total=total)
            return
        now = time.monotonic()
        if done == total or (done and now - self.last > LINE_EVERY_S):
            self.last = now
            print(f"{stage}: {done} of {total}", file=sys.stderr, flush=True)
