"""`slrig reconstruct`, which makes meshes of recorded bundles in this process, and `slrig warm`, which compiles its
kernels.
"""

from __future__ import annotations

import os
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from glob import glob
from pathlib import Path
from typing import Any

import typer
from rich.table import Column

from slrig.bundle import DESCRIPTION, natural_sort_key, read_calibration, read_description, write_file
from slrig.cli.display import ProgressDisplay, counted, print_table, progress_shown, quality_lines
from slrig.cli.loading import loading
from slrig.disk import prepare_kernel_cache, storage_errors
from slrig.errors import ConfigError, ExtraMissingError
from slrig.failure import UNEXPECTED, job_failure
from slrig.jobs.listener import PREPARING, Listener
from slrig.logs import set_up_console_logs
from slrig.scan.artefacts import MESH, ON_REQUEST, REPORT, report_summary, write_converted
from slrig.scan.formats import BUNDLE_ZIP, CALIBRATION_USED, missing_for, offered, on_demand
from slrig.scan.plan import ReconstructionPlan, RigGuess

Row = tuple[str, ...]
"""Cells of a bundle, or of one of its cameras, after name and seconds; the last is a remark."""
BUNDLE = "bundle"
"""The folder of a scan's frames in that of the scan: it is the scan that has a name."""
_MOST_NAMED = 5
"""Names in one message."""


def named_bundles(paths: Sequence[Path]) -> tuple[list[Path], bool]:
    """The bundles that arguments name, each once, and whether each has a folder of its own for its results.

    An argument is a bundle, a folder with bundles or scans as direct subfolders, or a pattern that the shell has
    not expanded, as on Windows. Other subfolders are named on stderr. Raises StorageError: a folder
    cannot be read.
    """
    found: dict[Path, Path] = {}
    several = False
    for one in paths:
        with storage_errors(one):
            for path in matching(one):
                inside = _bundles_inside(path)
                several |= bool(inside)
                found |= {bundle.absolute(): bundle for bundle in inside or [path]}
    return list(found.values()), several or len(found) > 1


def work_through(
    bundles: Sequence[Path],
    output: Path,
    work: Callable[[Path, Path, Listener], Sequence[Row]],
    *,
    prepare: Callable[[ProgressDisplay], object] = lambda _: None,
    heads: Sequence[Column],
    places: Sequence[str],
) -> None:
    """Work on each bundle, with progress, and print a table at every end.

    Every description is read before the first bundle is worked on. A failure is printed at once; the others go on.

    work : given a bundle, the folder for its results and the progress; returns rows. prepare : done once, if there is a
    bundle to work on. heads : of the cells of a `Row` but the last. places : lines that say where results lie.

    Raises
    ------
    ConfigError
        Two results would have one name, or `output` cannot hold several. Nothing was done.
    typer.Exit
        A bundle failed: 2, or 1 if that is a defect of slrig.
    """
    _require_room(bundles, output)
    done: dict[Path, list[Row]] = {}
    failed: dict[Path, str] = {}
    try:
        with progress_shown() as display:
            for bundle in bundles:
                with _failure_printed(bundle, failed, display):
                    read_description(bundle)
            if len(failed) < len(bundles):
                prepare(display)
            for place, bundle in enumerate(bundles, 1):
                if bundle in failed:
                    continue
                name, began_s = _name(bundle), time.monotonic()
                with _failure_printed(bundle, failed, display):
                    rows = work(bundle, output / name, _part_of(display, place, len(bundles), name))
                    labels = [(name, f"{time.monotonic() - began_s:.1f}"), *[("", "")] * (len(rows) - 1)]
                    done[bundle] = [
                        (label, *row[:-1], taken, row[-1]) for (label, taken), row in zip(labels, rows, strict=True)
                    ]
    finally:
        if done or failed:
            _print_summary(bundles, done, failed, heads, places)
    if failed:
        raise typer.Exit(1 if UNEXPECTED in failed.values() else 2)


def matching(paths: Path) -> list[Path]:
    """Paths that match a pattern, in natural order. A path, or a pattern without a match, gives itself."""
    matching = [] if paths.exists() else glob(str(paths))  # noqa: PTH207 - Path.glob takes no absolute pattern
    return sorted(map(Path, matching), key=natural_sort_key) or [paths]


def _bundles_inside(folder: Path) -> list[Path]:
    """The bundles among the direct subfolders of a folder that is none itself, or those of scans among them, in natural
    order.
    """
    if not folder.is_dir() or (folder / DESCRIPTION).is_file():
        return []
    inside = sorted((each for each in folder.iterdir() if each.is_dir() and each.name[0] != "."), key=natural_sort_key)
    # A scan of the service has its bundle next to its results.
    held = {each: [place for place in (each, each / BUNDLE) if (place / DESCRIPTION).is_file()][:1] for each in inside}
    found = [place for places in held.values() for place in places]
    skipped = [each.name for each, places in held.items() if not places]
    if found and skipped:
        typer.echo(f"{'skipped':<10}no {DESCRIPTION} in {_listed(skipped)} of {folder}", err=True)
    return found


def _name(bundle: Path) -> str:
    """Name of the bundle's folder, or of the scan that holds it; "." and ".." are folders that have one."""
    place = bundle if bundle.name not in ("", "..") else bundle.resolve()
    if place.name == BUNDLE:
        place = place.absolute().parent
    return place.name or BUNDLE


def _listed(names: Sequence[object]) -> str:
    more = len(names) - _MOST_NAMED
    return ", ".join(map(str, names[:_MOST_NAMED])) + (f" and {more} more" if more > 0 else "")


def _require_room(bundles: Sequence[Path], output: Path) -> None:
    """Refuse names of results that are equal, and a folder that holds something else (ConfigError)."""
    by_name: dict[str, list[Path]] = {}
    for bundle in bundles:
        # Windows and macOS take names for equal that differ in case.
        by_name.setdefault(_name(bundle).casefold(), []).append(bundle)
    equal = [_listed(each) for each in by_name.values() if len(each) > 1]
    if equal:
        message = (
            f"Results go into a folder of the bundle's name in {output}, and these have the same name: "
            f"{'; '.join(equal)}. Rename their folders, or reconstruct them one by one, each with its own --output."
        )
        raise ConfigError(message)
    if output.is_file() or (output / REPORT).exists():
        what = "a file" if output.is_file() else f"the result of one ({REPORT} lies in it)"
        message = (
            f"--output {output}: expected a folder for results of several bundles, found {what}; name a new folder"
        )
        raise ConfigError(message)


@contextmanager
def _failure_printed(bundle: Path, failed: dict[Path, str], display: ProgressDisplay) -> Iterator[None]:
    """Print the error that ends a bundle's work, and keep its code. An interruption is raised."""
    try:
        yield
    except Exception as error:  # noqa: BLE001 - after any error the other bundles are worked on
        failure = job_failure(error)
        text = failure.message if failure.code != UNEXPECTED else f"a defect of slrig\n{traceback.format_exc()}"
        display.error(text if str(bundle) in text else f"{bundle}: {text}")
        failed[bundle] = failure.code


def _part_of(display: ProgressDisplay, place: int, count: int, name: str) -> Listener:
    """Progress of one bundle as that of all. place : 1 for the first."""

    def report(stage: str, fraction: float, detail: str, /) -> None:
        where = f"{place} of {count}: {name}"
        display(stage, (place - 1 + fraction) / count, f"{where}, {detail}" if detail else where)

    return Listener(report=report)


def _print_summary(
    bundles: Sequence[Path],
    done: Mapping[Path, Sequence[Row]],
    failed: Mapping[Path, str],
    heads: Sequence[Column],
    places: Sequence[str],
) -> None:
    """Print a table of those that were begun, how many those are, and where results lie."""
    blank = [""] * (len(heads) + 1)
    rows = {**done, **{bundle: [(_name(bundle), *blank, f"failed: {code}")] for bundle, code in failed.items()}}
    table = [row for bundle in bundles for row in rows.get(bundle, ())]
    print_table((Column("bundle", overflow="fold"), *heads, Column("seconds", justify="right"), ""), table)
    counts = {"done": len(done), "failed": len(failed), "not done": len(bundles) - len(rows)}
    typer.echo(f"\n{'bundles':<10}{', '.join(f'{count} {what}' for what, count in counts.items() if count)}")
    for line in places if done else ():
        typer.echo(line)


def decode_and_print(paths: Sequence[Path], output: Path) -> None:
    """Decode bundles without a calibration, and print the findings and what to change. Raises as decoding does, and
    of several as `work_through` does.
    """
    from slrig.scan.reconstruct import decode_bundle

    set_up_console_logs()
    bundles, several = named_bundles(paths)
    if several:

        def decoded(bundle: Path, folder: Path, listener: Listener) -> list[Row]:
            listener.report("decode", 0.0, "")
            found, notes = decode_bundle(bundle, folder)
            listener.report("done", 1.0, "")
            return [
                (f"{each.camera}, {each.axis.value}s", f"{each.lit:.0%}", f"{each.decoded:.0%}",
                 "; ".join([*each.advice, *(notes if each is found[0] else ())]))
                for each in found
            ]  # fmt: skip

        heads = [Column("camera"), *map(_figures, ("lit", "decoded"))]
        work_through(bundles, output, decoded, heads=heads, places=[f"{'pictures':<10}{output / '*'}"])
        return
    (bundle,) = bundles
    with progress_shown() as display:
        display("decode", 0.0, str(bundle))
        found, notes = decode_bundle(bundle, output)
        display("done", 1.0, "")
    for each in found:
        typer.echo(f"{'decoded':<10}{each}")
        for advice in each.advice:
            typer.echo(f"{'':<10}{advice}")
    for note in notes:
        typer.echo(f"{'note':<10}{note}")
    typer.echo(f"{'pictures':<10}{output}")


def reconstruct_and_print(
    paths: Sequence[Path],
    output: Path,
    *,
    calibration: Path | None,
    further: Sequence[str],
    options: Mapping[str, Any],
    guess: Mapping[str, Any] | None = None,
) -> None:
    """Reconstruct, show the progress, and print where the results lie. Raises what the pipeline raises, and of several
    bundles what `work_through` does.

    further : names of files that are written as well; options : fields of `ReconstructionPlan` that were given; guess :
    fields of `RigGuess`, for bundles without a calibration. Raises ConfigError: there is a calibration, too.
    """
    set_up_console_logs()
    if guess is not None and calibration is not None:
        message = "--uncalibrated finds a calibration, and --calibration gives one; leave one of the two out"
        raise ConfigError(message)
    plan = ReconstructionPlan(**options, uncalibrated=None if guess is None else RigGuess(**guess))
    bundles, several = named_bundles(paths)
    # What is wrong with the files is said at once, not after a minute in which kernels are compiled.
    further = tuple(dict.fromkeys(further))
    if not several:
        _require_offered(further, bundles[0])
    if calibration is not None:
        read_calibration(calibration)

    def reconstructed(bundle: Path, folder: Path, listener: Listener) -> dict[str, Any]:
        from slrig.scan.reconstruct import reconstruct_bundle

        cameras = _require_offered(further, bundle)
        report = reconstruct_bundle(bundle, folder, listener, plan=plan, calibration=calibration)
        for name in further:
            listener.report(f"writing {name}", 1.0, "")
            _write_further(folder, name, cameras, bundle, calibration)
        return report_summary(report)

    always = (MESH, "preview.png", REPORT)
    named = [(Path(name).suffix[1:], name) for name in further if name not in always]
    files = (("mesh", MESH), *named, ("preview", "preview.png"), ("report", "report.json"))
    if several:
        work_through(
            bundles, output, lambda *each: [_row(reconstructed(*each))], prepare=prepare_kernels,
            heads=[_figures(name) for name in ("triangles", "median σ", "covered")],
            places=[f"{what:<10}{output / '*' / name}" for what, name in files],
        )  # fmt: skip
        return
    with progress_shown() as display:
        prepare_kernels(display)
        summary = reconstructed(bundles[0], output, Listener(report=display))
    for what, name in files:
        typer.echo(f"{what:<10}{output / name}")
    for line in quality_lines(summary):
        typer.echo(line)


def _require_offered(names: Sequence[str], bundle: Path) -> list[str]:
    """The cameras of a bundle. Raises ConfigError: its reconstruction has not one of the files; ExtraMissingError: one
    takes a library that is not installed; and as `read_description`.
    """
    cameras = list(read_description(bundle).camera_formats())
    there_are = [name for name in offered(cameras) if name not in (CALIBRATION_USED, BUNDLE_ZIP)]
    unknown = [name for name in names if name not in there_are]
    if unknown:
        message = f"{bundle}: it gives no {', '.join(unknown)}. There are: {', '.join(there_are)}."
        raise ConfigError(message)
    for name in names:
        lacking = missing_for(name)
        if lacking is not None:
            message = f"{name} takes a library that is not installed: {lacking}"
            raise ExtraMissingError(message)
    return cameras


def _write_further(folder: Path, name: str, cameras: Sequence[str], bundle: Path, calibration: Path | None) -> None:
    """Write a file of a reconstruction that is made only on request. Raises as its maker does."""
    found = on_demand(name, cameras)
    if found is not None:
        from slrig.scan.clouds import cloud_file

        write_file(folder / name, cloud_file(folder, *found, bundle=bundle, calibration=calibration))
    elif name in ON_REQUEST:
        write_converted(folder, name)


def _figures(name: str) -> Column:
    return Column(name, justify="right", no_wrap=True)


def _row(summary: Mapping[str, Any]) -> Row:
    """Row of a reconstruction: triangles, median of the stated deviations, share covered, a remark."""
    mesh = summary["mesh"]
    sigma_mm, covered, notes = mesh["sigma_mm"]["p50"], mesh["covers_of_decoded"], summary["notes"]
    return (
        f"{mesh['figures']['triangles']:,}",
        "" if sigma_mm is None else f"{sigma_mm:.4f} mm",
        "" if covered is None else f"{covered:.1%}",
        f"{counted(len(notes), 'note')} in report.json" if notes else "",
    )


def warm() -> None:
    """Compile or load the kernels of a usual scan, and print how many there are and where they are kept."""
    began_s = time.monotonic()
    with progress_shown() as display:
        count = prepare_kernels(display)
    # numba: a second.
    from slrig.kernels import why_compiled

    place = os.environ.get("NUMBA_CACHE_DIR") or "next to slrig's own files"
    why = why_compiled()
    kept = "as they came with slrig" if why is None else f"kept {place}; compiled here, because {why}"
    typer.echo(f"{count} kernels are ready, {kept} ({time.monotonic() - began_s:.0f} s)")


def prepare_kernels(display: ProgressDisplay) -> int:
    """Compile the kernels of a usual scan that no earlier run has, under progress; return how many there are."""
    keep_kernels()
    display("loading", 0.0, "")
    with loading():
        from slrig.kernels import KernelCount, are_all_cached, count_prepared
        from slrig.scan.reconstruct import warm_kernels

    def report(now: KernelCount) -> None:
        display(PREPARING, 0.0, f"first time only: {now.done} of {now.total}")

    if not are_all_cached():
        warm_kernels(report)
    return count_prepared().total


def keep_kernels() -> None:
    """Keep the kernels of this process in the cache of its user."""
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    prepare_kernel_cache(Path(base) / "slrig")
