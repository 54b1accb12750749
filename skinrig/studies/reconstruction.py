"""Reconstruct several sessions on an executor; each is read and written by its path."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from capture.plan.rig_kinds import find_rig_kind
from capture.session import Session, SessionError
from model import store
from reconstruction.pipeline import recipes
from reconstruction.pipeline.checkpoints import work_folder
from reconstruction.pipeline.inputs import DomeOptions, InputsError
from reconstruction.tiles import map_tiles
from skinrig.errors import UnusableError
from skinrig.resources.forecast import (
    Task,
    count_megapixels,
    measure_folder_mb,
    require_resources_of_jobs,
)
from skinrig.studies.description import require_software, software_hash
from skinrig.studies.executors import (
    ExecutorLost,
    count_local_processes,
    describe_lost_task,
    ended_workers,
    open_executor,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class ReconstructionOrder:
    """Small, picklable arguments of `reconstruction.pipeline.recipes.reconstruct`."""

    session: Path
    want: tuple[str, ...]
    out: Path
    calibration: Path | None
    state: str
    landmarks: Path | None
    truth: str
    dome: DomeOptions

    def with_absolute_paths(self) -> "ReconstructionOrder":
        """Return the order with absolute paths, for a process whose working folder differs."""
        dome = self.dome
        return replace(
            self,
            session=self.session.absolute(),
            out=self.out.absolute(),
            calibration=_make_absolute(self.calibration),
            landmarks=_make_absolute(self.landmarks),
            dome=replace(dome, scan=_make_absolute(dome.scan), basis=_make_absolute(dome.basis)),
        )


def _make_absolute(path: str | Path | None) -> Path | None:
    return None if path is None else Path(path).absolute()


@dataclass(frozen=True, slots=True)
class ReconstructionSummary:
    """What a reconstruction did, without its maps, which are in its folder."""

    ran: tuple[str, ...]
    reused: tuple[str, ...]
    omitted: tuple[tuple[str, str], ...]
    assumed: tuple[str, ...]
    work: tuple[Mapping[str, str], ...]


def reconstruct_session(
    order: ReconstructionOrder, progress: Callable[[str, float | None], None] | None = None
) -> ReconstructionSummary:
    """Reconstruct one session into its folder.

    Parameters
    ----------
    order
        Session, maps and folders.
    progress
        Called before each stage or part that runs, with one line and the seconds left, if known.
    """
    done = recipes.reconstruct(
        order.session,
        want=order.want,
        out=order.out,
        calibration=order.calibration,
        state=order.state,
        landmarks=order.landmarks,
        progress=progress,
        truth=order.truth,
        dome=order.dome,
    )
    return ReconstructionSummary(done.ran, done.reused, done.omitted, done.assumed, done.work)


def _reconstruct_on_worker(order: ReconstructionOrder, software: str) -> ReconstructionSummary:
    require_software(software)
    return reconstruct_session(order)


def _require_room(orders: Sequence[ReconstructionOrder], executor: str) -> None:
    """Raise unless memory and disk suffice; images under lights of a list are not forecast.

    A session that cannot be read here is refused when its own turn comes. One whose maps are there
    needs nothing, unless an option has changed.
    """
    jobs, held_mb = [], 0.0
    for order in orders:
        try:
            session = Session.open(order.session)
        except SessionError:
            continue
        if "light_list" not in session.manifest.extra and not _has_maps(order, session):
            work = f"reconstruct {find_rig_kind(session.rig)}"
            sizes = count_megapixels(session.rig, session.plan, session.omitted_steps())
            jobs.append([Task(work, sizes)])
            held_mb += measure_folder_mb(order.out) + measure_folder_mb(work_folder(order.out))
    processes = count_local_processes(executor)
    require_resources_of_jobs(jobs, orders[0].out, processes=processes, held_mb=held_mb)


def _has_maps(order: ReconstructionOrder, session: Session) -> bool:
    """Return whether an output has all wanted maps of the content of a session."""
    try:
        found = store.read_document(order.out)
        want = recipes.recipe_for_session(session).expand(session, order.want)
    except (store.StoreError, InputsError):
        return False
    named = {*found.maps, *found.files, *(name for name, _ in found.left_out)}
    return found.inputs.get("session") == session.content_hash and named.issuperset(want)


def reconstruct_sessions(
    orders: Sequence[ReconstructionOrder],
    *,
    executor: str,
    progress: Callable[[str, float | None], None],
) -> Iterator[ReconstructionSummary]:
    """Yield the summary of each session, in order.

    Parameters
    ----------
    orders
        Sessions.
    executor
        See `skinrig.studies.executors.open_executor`.
    progress
        Called before each stage of a session in this process; elsewhere before the first session
        and after each.

    Raises
    ------
    skinrig.studies.executors.ExecutorLost
        If the connection to the scheduler is lost; maps that were written stay.
    skinrig.errors.UnusableError
        If a session ends its workers, or a worker has other software than this process.
    """
    _require_room(orders, executor)
    with open_executor(executor) as pool:
        if pool is None:
            for order in orders:
                if len(orders) > 1:
                    progress(str(order.session), None)
                yield reconstruct_session(order, progress)
            return
        placed = [order.with_absolute_paths() for order in orders]
        work = partial(_reconstruct_on_worker, software=software_hash())
        made = map_tiles(work, placed, executor=pool, window=max(len(orders), 1))
        complete = 0
        progress(f"sessions: 0/{len(orders)}", None)
        try:
            for summary in made:
                session = orders[complete].session
                complete += 1
                progress(f"sessions: {complete}/{len(orders)}, last {session}", None)
                yield summary
        except CancelledError as error:
            raise ExecutorLost(
                f"--executor: the connection to the scheduler of {executor} was lost; run the "
                "same command again, complete maps are reused"
            ) from error
        except Exception as error:
            if not ended_workers(error):
                raise
            lost = describe_lost_task(error)
            raise UnusableError(f"{orders[complete].session}: {lost}") from error
