"""A folder of patients, each in a process of its own: one that crashes costs only itself."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Protocol

from pipeline.batch_ending import how_it_ended, old_products
from pipeline.batch_plan import LOGS, Plan, Shard, notes_on, plan_batch, products_of
from pipeline.batch_table import INTERRUPTED, NO_STUDY, WAITING, Ended, Outcome, outcome_of, rows
from pipeline.batch_table import write_table as write_csv
from pipeline.errors import NOT_TO_BE_USED, InputError
from pipeline.publish import (
    PARTIAL,
    locked,
    read_record,
    readable_write_errors,
    record_stamp,
    remove,
)
from pipeline.sealing import STAGE_FILE

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
LOOK_S = 0.5
"""How often the main thread looks for signals: one that came to another does not wake it."""

NAME_BYTES = 255
"""Most that file systems take for a name."""


class BatchWatcher(Protocol):
    """Whoever shows the user how the batch goes."""

    def ended(self, outcome: Outcome, done: int, total: int) -> None:
        """A study ended: how many have, and of how many."""

    def interrupted(self, running: int) -> None:
        """No other study begins; so many are waited for."""


@dataclass(frozen=True, slots=True)
class Batch:
    """How a batch ended."""

    table: Path
    """The file that holds the outcomes."""

    outcomes: list[Outcome]
    """By name; those of folders that are no study among them."""

    notes: list[str]
    """What lies in either folder and belongs to no study."""

    interrupted: bool
    unwritten: InputError | None
    """Why the table could not be written, if so."""


def run_batch(
    studies: Path,
    out: Path,
    workers: int,
    config: Path | None,
    watcher: BatchWatcher,
    last: str | None,
    shard: Shard,
) -> Batch:
    """Run every study below ``studies``; write ``out/batch.csv`` after each.

    Runs end after the stage ``last``, where one is given. Of a ``shard`` only its part is run, and
    told in a table of its own; other shards may be at work in ``out`` at the same time.

    A signal that ends programs begins no other study and is passed to those that run, which are
    waited for; SIGINT once more ends them at once.

    Raises
    ------
    InputError
        When there is nothing to run (see `plan_batch`), ``out`` cannot be written, or another batch
        (of a shard: another of the same part, or a whole one) is at work in it.
    """
    plans = plan_batch(studies, out)
    with locked(out, shard.name):
        for orphan in out.glob(f".{shard.table}{PARTIAL}*"):
            remove(orphan)
        with readable_write_errors(out / LOGS):
            (out / LOGS).mkdir(exist_ok=True)
        batch = _Running(out, config, last, watcher, shard.part(plans), out / shard.table)
        batch.run(workers)
        return batch.end(notes_on(studies, out, plans))


class _Children:
    """The processes that run."""

    def __init__(self) -> None:
        self.stopped = False
        self._running: set[subprocess.Popen[bytes]] = set()
        # Signals may come while the thread that they come to holds it.
        self._lock = threading.RLock()

    def call(self, command: Sequence[str], log: IO[Any]) -> int | None:
        """Run a command; return its exit code, or None where none is to be begun any more."""
        with self._lock:
            if self.stopped:
                return None
            # Children know by the end of their input that this process is no more.
            child = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=log, stderr=subprocess.STDOUT
            )
            self._running.add(child)
        with child:
            code = child.wait()
        with self._lock:
            self._running.remove(child)
        return code

    def stop(self, how: signal.Signals) -> int:
        """Begin no other, and send a signal to those that run; return how many do."""
        with self._lock:
            self.stopped = True
            for child in self._running:
                child.send_signal(how)
            return len(self._running)


@contextmanager
def _passing_signals_on(children: _Children, watcher: BatchWatcher) -> Iterator[None]:
    """Let signals that end programs stop the children in place of this program.

    Signals that are ignored, as `nohup` does, stay so. Python tells signals to the main thread
    alone; in another, who runs the batch sees to them.
    """

    def passed_on(number: int, _frame: object) -> None:
        if not children.stopped:
            watcher.interrupted(children.stop(signal.SIGTERM))
        elif number == signal.SIGINT:
            children.stop(signal.SIGKILL)

    before: dict[signal.Signals, Any] = {}
    if threading.current_thread() is threading.main_thread():
        before = {one: signal.getsignal(one) for one in ENDING}
    heard = {one: way for one, way in before.items() if way not in (None, signal.SIG_IGN)}
    for one in heard:
        signal.signal(one, passed_on)
    try:
        yield
    finally:
        for one, way in heard.items():
            signal.signal(one, way)


class _Running:
    def __init__(
        self,
        out: Path,
        config: Path | None,
        last: str | None,
        watcher: BatchWatcher,
        plans: Sequence[Plan],
        table: Path,
    ) -> None:
        self._out, self._watcher, self._plans, self._table = out, watcher, plans, table
        self._options = ["--out", str(out)]
        self._options += ["--config", str(config)] if config else []
        self._options += ["--until", last] if last else []
        self._children = _Children()
        self._ended: list[Ended] = []
        self._waiting: dict[str, Ended] = {}

    def run(self, workers: int) -> None:
        """Run all studies that can be, and tell of the others first."""
        for plan in self._plans:
            if not plan.is_study:
                why = "has neither cine/ nor study.yaml"
                self._ended.append(outcome_of(plan, NO_STUDY, why))
            elif plan.refused:
                self._tell(self._not_done(plan, "failed", plan.refused))
        able = [plan for plan in self._plans if plan.is_study and not plan.refused]
        # A batch that is killed must not leave the table of another, nor one that looks whole.
        self._waiting = {plan.name: self._not_begun(plan, WAITING) for plan in able}
        self._write()
        with (
            _passing_signals_on(self._children, self._watcher),
            ThreadPoolExecutor(workers) as pool,
        ):
            try:
                waited_for = {pool.submit(self._run_one, one) for one in able}
                while waited_for:
                    finished, waited_for = wait(waited_for, LOOK_S, FIRST_COMPLETED)
                    for one in finished:
                        self._tell(one.result())
            except BaseException:
                # The pool waits for its threads, and they for the children.
                self._children.stop(signal.SIGTERM)
                raise

    def end(self, notes: list[str]) -> Batch:
        """Write the whole table."""
        outcomes = rows(self._ended)
        unwritten = write_csv(self._table, outcomes)
        return Batch(self._table, outcomes, notes, self._children.stopped, unwritten)

    def _tell(self, one: Ended) -> None:
        self._ended.append(one)
        self._waiting.pop(one.outcome.patient, None)
        self._write()
        total = sum(plan.is_study for plan in self._plans)
        done = sum(other.outcome.status != NO_STUDY for other in self._ended)
        self._watcher.ended(one.outcome, done, total)

    def _write(self) -> None:
        # What cannot be written now may be later; only the last time counts.
        write_csv(self._table, rows([*self._ended, *self._waiting.values()]))

    def _run_one(self, plan: Plan) -> Ended:
        try:
            return self._call(plan)
        except InputError as error:
            return self._not_done(plan, "failed", str(error))
        except Exception as error:  # one study's trouble, whatever it is, costs only that study
            return self._not_done(plan, "crashed", f"{type(error).__name__}: {error}")

    def _call(self, plan: Plan) -> Ended:
        if self._children.stopped:
            return self._not_begun(plan)
        # Not from the folder in which the user happens to be.
        command = [sys.executable, "-P", "-m", "pipeline.batch_member", "run", str(plan.folder)]
        command += self._options
        log = self._out / LOGS / _log_name(plan.name)
        before = record_stamp(products_of(self._out, plan))
        clock = time.perf_counter()
        with readable_write_errors(log):
            handle = log.open("w")
        with handle:
            code = self._children.call(command, handle)
        if code is None:
            return self._not_begun(plan)
        seconds = time.perf_counter() - clock
        status, cause = how_it_ended(code, log, self._children.stopped)
        if status != "done":
            return self._not_done(plan, status, cause, seconds, before)
        products = products_of(self._out, plan)
        record = read_record(products)
        if "stages" not in record:
            lost = products or self._out / (plan.patient_id or plan.name)
            cause = f"{lost}/run.json: cannot be read though the run ended well; run it again"
            return self._not_done(plan, "failed", cause, seconds, before)
        # After --until, what lies behind may be of other settings.
        return outcome_of(plan, status, old_products(products, True), seconds, record, products)

    def _not_begun(self, plan: Plan, status: str = INTERRUPTED) -> Ended:
        """A study that nothing is known to be done about; its products may well hold."""
        products = products_of(self._out, plan)
        cause = "not begun" if status == INTERRUPTED else "had not ended when this was written"
        if products and any(products.glob(f"*/{STAGE_FILE}")):
            cause += f"; {products} holds products of an earlier run, if of other settings or input"
        shown = (
            products if read_record(products).get("study") == str(plan.folder.resolve()) else None
        )
        return outcome_of(plan, status, cause, products=shown)

    def _not_done(
        self,
        plan: Plan,
        status: str,
        cause: str,
        seconds: float = 0.0,
        before: tuple[int, int] | None = None,
    ) -> Ended:
        """A study that is not done, and what an earlier run of it left standing."""
        products = products_of(self._out, plan)
        record = read_record(products)
        came_to_a_stage = before not in (None, record_stamp(products))
        if NOT_TO_BE_USED not in cause:
            cause = "; ".join(filter(None, (cause, old_products(products, came_to_a_stage))))
        shown = products if record.get("study") == str(plan.folder.resolve()) else None
        of_this_run = record if shown and came_to_a_stage else None
        return outcome_of(plan, status, cause, seconds, of_this_run, shown)


def _log_name(patient: str) -> str:
    """Name of a patient's log; a folder's name may leave no room for the ending."""
    name = os.fsencode(patient)
    if len(name) + len(".log") <= NAME_BYTES:
        return f"{patient}.log"
    # The digest keeps two names apart that begin in the same way.
    return f"{os.fsdecode(name[:200])}-{hashlib.sha256(name).hexdigest()[:8]}.log"
