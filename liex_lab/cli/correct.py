"""The commands of `liex correct`: add corrections to a session, and undo them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import liex_lab
from liex_lab import api
from liex_lab.cli.options import SessionPath, command_group, echo, print_table
from liex_lab.errors import SessionError
from liex_lab.runtime.progress import progress_bar

if TYPE_CHECKING:
    from liex_lab.sessions.corrections import Correction

correct = command_group("Correct a session; corrections are kept in its folder and can be undone.")

Author = Annotated[
    str,
    typer.Option(
        "--by",
        metavar="NAME",
        help="Author of the correction; default: the current account.",
    ),
]


@correct.command()
def flip(
    session: SessionPath,
    start_s: Annotated[
        float, typer.Option("--from", metavar="S", help="Seconds since the first frame.")
    ],
    stop_s: Annotated[
        float, typer.Option("--to", metavar="S", help="Seconds since the first frame, exclusive.")
    ],
    by: Author = "",
) -> None:
    """Exchange head and tail in a time span."""
    _parse_and_apply(session, ["flip", start_s, stop_s], by)


@correct.command()
def joint(
    session: SessionPath,
    frame: Annotated[int, typer.Option("--frame", help="Frame index, as in frames.parquet.")],
    name: Annotated[str, typer.Option("--joint", help="Name of the joint.")],
    to_mm: Annotated[
        tuple[float, float, float] | None,
        typer.Option("--to-mm", metavar="X Y Z", help="Position in the arena frame, mm."),
    ] = None,
    to_px: Annotated[
        tuple[float, float] | None,
        typer.Option(
            "--to-px", metavar="U V", help="Pixel of the depth image under which the joint lies."
        ),
    ] = None,
    by: Author = "",
) -> None:
    """Move a joint in one frame; the others follow within bone lengths and limits."""
    if (to_mm is None) == (to_px is None):
        raise SessionError(
            "a joint's place is given in one way: --to-mm X Y Z in the arena, or --to-px U V"
        )
    _parse_and_apply(session, ["joint", name, frame, *(to_px or to_mm or ())], by)


@correct.command()
def bout(
    session: SessionPath,
    at_s: Annotated[
        float | None, typer.Option("--at", metavar="S", help="A time within the bout to edit, s.")
    ] = None,
    action: Annotated[str | None, typer.Option("--action", help="Name of the action.")] = None,
    start_s: Annotated[
        float | None, typer.Option("--from", metavar="S", help="Seconds since the first frame.")
    ] = None,
    stop_s: Annotated[
        float | None, typer.Option("--to", metavar="S", help="Seconds, exclusive.")
    ] = None,
    delete: Annotated[bool, typer.Option("--delete", help="Delete the bout.")] = False,
    labels: Annotated[
        Path | None,
        typer.Option(
            "--labels",
            metavar="FILE",
            help="Import a whole ethogram: .csv, .parquet, .boris, or syllables (results.h5).",
        ),
    ] = None,
    new_word: Annotated[
        bool,
        typer.Option(
            "--new-word", help="Allow an action that is not in the ethogram's vocabulary."
        ),
    ] = False,
    by: Author = "",
) -> None:
    """Edit bouts: rename, move, delete or add one, or import a whole ethogram.

    Rename: --at, --action (the present name confirms it). New span: --at, --from, --to. Delete:
    --at, --delete. Add: --action, --from, --to. Whole ethogram: --labels.
    """
    new = ["new"] if new_word else []
    match (at_s, action, start_s, stop_s, delete, labels):
        case (None, None, None, None, False, Path()):
            from liex_lab.sessions.correcting import labelled_bouts

            opened = _opened(session)
            _do(session, labelled_bouts(opened, api.read_any_labels(labels, opened)), by)
        case (None, str(), float(), float(), False, None):
            _parse_and_apply(session, ["add", action, start_s, stop_s, *new], by)
        case (float(), str(), None, None, False, None):
            _parse_and_apply(session, ["rename", at_s, action, *new], by)
        case (float(), None, float(), float(), False, None):
            _parse_and_apply(session, ["recut", at_s, start_s, stop_s], by)
        case (float(), None, None, None, True, None):
            _parse_and_apply(session, ["delete", at_s], by)
        case _:
            raise SessionError(
                "one edit at a time: --at S with --action, with --from and --to, or with "
                "--delete; --action with --from and --to; or --labels FILE"
            )


@correct.command()
def swap(
    session: SessionPath,
    other: Annotated[Path, typer.Argument(help="Session of the other animal.")],
    start_s: Annotated[
        float, typer.Option("--from", metavar="S", help="Seconds since the first frame.")
    ],
    stop_s: Annotated[
        float | None,
        typer.Option("--to", metavar="S", help="Seconds, exclusive; default: the end."),
    ] = None,
    by: Author = "",
) -> None:
    """Exchange two animals of one recording in a time span, in both sessions."""
    from liex_lab.sessions import identities

    _do(session, [identities.swap(_opened(session), _opened(other), start_s, stop_s)], by)


@correct.command()
def crossing(
    session: SessionPath,
    at_s: Annotated[float, typer.Option("--at", metavar="S", help="A time within it, s.")],
    by: Author = "",
) -> None:
    """Confirm that the animals are right after a crossing, in the sessions of all of them."""
    _parse_and_apply(session, ["crossing", at_s], by)


@correct.command("list")
def list_corrections(session: SessionPath) -> None:
    """List all corrections with author, time and state."""
    from liex_lab.sessions.corrections import FOLDER, applies, read_log

    opened = liex_lab.Session.open(session, raw=True)
    log = read_log(opened.path)
    if not log.entries:
        echo(f"{opened.path} has no corrections")
        return
    standing = {entry.number for entry in log.standing}
    rows = [
        (
            entry.number,
            f"{entry.undoes} taken back" if entry.what is None else entry.what,
            entry.author,
            entry.made_at,
            "" if entry.what is None or entry.number in standing else "taken back",
        )
        for entry in log.entries
    ]
    print_table(rows, "", "what", "by", "at", "")
    if log.standing and not applies(log, opened.path, opened.metadata):
        echo(
            "note: they were made on another measurement of this recording and are not applied; "
            f"`liex correct apply` applies them, and without the folder {FOLDER} they are gone"
        )


@correct.command()
def undo(
    session: SessionPath,
    numbers: Annotated[
        list[int] | None,
        typer.Argument(metavar="[NUMBER]...", help="Default: the last correction."),
    ] = None,
    by: Author = "",
) -> None:
    """Undo corrections by their numbers in `liex correct list`."""
    from liex_lab.sessions.corrections import read_log

    standing = read_log(_opened(session).path).standing
    if not standing and not numbers:
        raise SessionError(f"{session} has no correction to take back")
    _do(session, [], by, numbers or [standing[-1].number])


@correct.command()
def redo(session: SessionPath, by: Author = "") -> None:
    """Redo the correction that was undone last."""
    from liex_lab.sessions.corrections import read_log

    redoable = read_log(_opened(session).path).redoable
    if redoable is None:
        raise SessionError(
            f"{session} has no correction to make again: none was taken back since the last new "
            "one; `liex correct apply` makes the corrected tables and the report again"
        )
    number, what = redoable
    _do(session, [], by, [number])
    echo(f"again:     {what}")


@correct.command()
def apply(session: SessionPath) -> None:
    """Apply all corrections to the measured tables again, and regenerate the report."""
    _do(session, [], "")


def describe(
    session: SessionPath,
    facts: Annotated[
        list[str],
        typer.Argument(
            metavar="KEY=VALUE...",
            help="subject_id, group, cage, sex, batch, species, age or session_start_time; KEY= "
            "removes the value.",
        ),
    ],
    by: Author = "",
) -> None:
    """Set facts about a session's animal, such as subject_id=m07 group=drug."""
    given = {}
    for fact in facts:
        key, equals, value = fact.partition("=")
        if not equals:
            raise SessionError(f"a fact is written as KEY=VALUE, such as group=drug, not {fact!r}")
        given[key.strip()] = value.strip()
    with progress_bar() as progress:
        api.describe_session(session, given, author=by, progress=progress)
    for key, value in given.items():
        echo(f"described: {key} is {value or 'not known'}")
    echo(f"report:    {session / 'report.html'}")


def sync(
    session: SessionPath,
    other: Annotated[
        Path | None,
        typer.Option(
            "--with",
            metavar="FILE",
            help="Pulses of the other instrument: .csv, .npy, .npz, .nwb, a folder of Open Ephys, "
            "SpikeGLX's or Harp's .bin.",
        ),
    ] = None,
    channel: Annotated[
        str, typer.Option("--channel", help="Column, array, series, line or bit of the pulses.")
    ] = "",
    pulses: Annotated[
        Path | None,
        typer.Option(
            "--pulses",
            metavar="FILE",
            help="The same pulses in seconds since the session's first frame; default: one for "
            "each frame.",
        ),
    ] = None,
    patch: Annotated[
        str | None,
        typer.Option(
            "--patch",
            metavar="LEFT,TOP,RIGHT,BOTTOM",
            help="Pixels of the recorded depth image whose mean falls at each pulse, as by an LED.",
        ),
    ] = None,
    infrared: Annotated[
        str | None,
        typer.Option(
            "--infrared",
            metavar="TOPIC",
            help="Topic of 16-bit infrared images in the recording: the patch is sought there, and "
            "its mean rises.",
        ),
    ] = None,
    pairs: Annotated[
        Path | None,
        typer.Option(
            "--pairs", metavar="CSV", help="Moments on both clocks: columns time_s and other_s."
        ),
    ] = None,
    first: Annotated[
        bool, typer.Option("--first", help="The first pulses of both sides are the same.")
    ] = False,
    events: Annotated[
        Path | None,
        typer.Option(
            "--events",
            metavar="CSV",
            help="Events of the other instrument, columns event and time_s, for the table events.",
        ),
    ] = None,
    by: Author = "",
) -> None:
    """Put a session's times on the clock of another instrument, by pulses that both recorded."""
    try:
        left, top, right, bottom = (int(cell) for cell in (patch or "0,0,0,0").split(","))
    except ValueError:
        raise typer.BadParameter("--patch takes LEFT,TOP,RIGHT,BOTTOM, four pixels") from None
    with progress_bar() as progress:
        fit = api.sync_session(
            session,
            other,
            channel=channel,
            pulses=pulses,
            patch=(left, top, right, bottom) if patch else None,
            infrared=infrared,
            pairs=pairs,
            first=first,
            events=events,
            author=by,
            progress=progress,
        )
    ours, others = fit.n_unmatched
    echo(f"synced:    {fit}")
    echo(f"alone:     {ours} events of the session and {others} of {fit.name}")
    sd_ms = _opened(session).table("frames", ["sync_sd_ms"])["sync_sd_ms"]
    error = f"{sd_ms.median():.3f} ms in the median, {sd_ms.max():.3f} ms at most"
    echo(f"error:     {'unknown, of two pairs' if fit.sd_s is None else error}")
    echo(f"tables:    {session / 'corrected'} (frames sync_s; bouts sync_start_s and sync_stop_s)")
    echo(f"report:    {session / 'report.html'}")


def _opened(session: Path) -> liex_lab.Session:
    return liex_lab.Session.open(session)


def _parse_and_apply(session: Path, sentence: Sequence[object], by: str) -> None:
    from liex_lab.sessions.correcting import parse_correction

    _do(session, [parse_correction(_opened(session), sentence)], by)


def _do(session: Path, what: Sequence[Correction], by: str, undo: Sequence[int] = ()) -> None:
    from liex_lab.sessions.correcting import disagreements
    from liex_lab.sessions.corrections import read_log

    with progress_bar() as progress:
        api.correct_session(session, what, undo=undo, author=by, progress=progress)
    for one in what[:5]:
        echo(f"corrected: {one}")
    for sentence in disagreements(_opened(session)):
        echo(f"note:      {sentence}")
    if len(what) > 5:
        echo(f"corrected: {len(what) - 5} further bouts")
    for path in read_log(session).beside(session) or [session]:
        echo(f"tables:    {path / 'corrected'}")
        echo(f"report:    {path / 'report.html'}")
