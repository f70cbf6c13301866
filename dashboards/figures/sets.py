"""The sets of figures of a session, a study and a comparison, and their files."""

import io
import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure

from liex_lab.behaviour.cohort import SUBJECT, unit_of
from liex_lab.errors import SessionError, did_you_mean, expecting
from liex_lab.plan.study import references_first
from liex_lab.runtime import durable, memory, text_files
from liex_lab.runtime.progress import Progress, silent
from liex_lab.sessions import Session

from . import days, groups, places, social, times
from .animals import DepthImages, SessionAnimal, keeps_depth, session_animals
from .style import FORMATS, drawing, image_bytes, on_page

FOLDER = "figures"
PAGES = "pages"  # the format with all figures in one file, one per page
KINDS = (*FORMATS, PAGES)
_PAGES_FILE = "figures.pdf"
COMPARISON_FILE = "comparison.json"
OF_SESSION: dict[str, tuple[str, Callable[[SessionAnimal], Figure | None]]] = {
    "ethogram": ("what the animal did when", times.ethogram),
    "curves": ("speed, heights and predicted error over time", times.curves),
    "occupancy": ("time per area of the floor, with walls and zones", places.occupancy_map),
    "trajectory": ("way of the body's centre from above", places.trajectory),
    "arena": ("heights of the arena above its floor", lambda animal: _arena(animal.session)),
    "time_budget": ("share of the time in each action", times.time_budget),
    "activity": ("shares of the actions over the session", times.activity),
    "actogram": ("activity by the time of day, in light and dark", days.actogram),
    "transitions": ("what follows upon what, against chance", times.transitions),
    "interactions": ("the interactions of each pair, number and time", social.interaction_matrix),
    "network": ("the group of animals and their interactions", social.interaction_network),
    "onsets": ("measures about the onsets of actions", times.aligned_curves),
    "events": ("measures about events of another instrument", times.event_curves),
    "distance": ("distance summed up over the session", times.cumulative_distance),
    "speed": ("share of the time at each speed", times.speed_distribution),
    "error": ("share of the time at each predicted error", times.error_distribution),
    "sync": ("residuals of the events on both clocks", times.clock_residuals),
}
OF_STUDY: dict[str, tuple[str, Callable[[Sequence[SessionAnimal]], Figure | None]]] = {
    "ethograms": ("a row for each session", groups.ethograms),
    "occupancy_subjects": ("occupancy of every subject", groups.occupancy_by_subject),
    "occupancy_groups": ("occupancy of every group", groups.occupancy_by_group),
    "time_budgets": ("shares of the actions, every subject", groups.budgets_by_group),
    "distances": ("cumulative distance, every session", groups.distance_by_group),
    "events_groups": ("measures about events, every subject", groups.events_by_group),
}


# name of its files, description, and the figure; None if there is nothing to draw
Drawn = tuple[str, str, Figure | None]


def session_figures(session: Session, only: Sequence[str] = ()) -> Iterator[Drawn]:
    """Yield every figure of a session; call it inside `style.drawing()`.

    With several animals, each has its own figures, whose names end in the animal's name.

    Args:
        session: the opened session.
        only: names of `OF_SESSION`; () draws all.
    """
    for animal in session_animals(session):
        for name in only or OF_SESSION:
            what, draw = OF_SESSION[name]
            own = name if animal.alone else durable.safe_name(f"{name}-{animal.individual}")
            yield own, what, draw(animal)


def study_figures(sessions: Sequence[Session], only: Sequence[str] = ()) -> Iterator[Drawn]:
    """Yield every figure of a study; call it inside `style.drawing()`.

    Args:
        sessions: the opened sessions.
        only: names of `OF_STUDY`; () draws all.
    """
    yield from _of_many(
        [animal for session in sessions for animal in session_animals(session)], only
    )


def comparison_figures(
    table: pd.DataFrame,
    stats: pd.DataFrame,
    sessions: Sequence[Session],
    only: Sequence[str] = (),
) -> Iterator[Drawn]:
    """Yield every figure of a comparison; call it inside `style.drawing()`.

    Args:
        table: the comparison's sessions.csv.
        stats: its table `stats`.
        sessions: the opened sessions; () omits the figures that need them.
        only: names of `OF_STUDY`, 'effects', or measures of `stats`; () draws all.
    """
    columns = pd.concat(
        [
            pd.DataFrame(columns=["table", "name", "unit"]),
            *(session.columns for session in sessions),
        ]
    )
    known = columns[columns["table"] == "summary"].drop_duplicates("name")
    units = dict(zip(known["name"].astype(str), known["unit"].fillna("").astype(str), strict=True))
    units = {name: unit_of(name, units) for name in stats["measure"].astype(str)}
    accounted = str(table.attrs.get("accounted", ""))
    only = only or ("effects", *stats["measure"].astype(str), *OF_STUDY)
    if "effects" in only:
        yield "effects", "effect sizes with their intervals", groups.effects(stats, units)
    for measure in (one for one in dict.fromkeys(stats["measure"].astype(str)) if one in only):
        drawn = groups.comparison(table, stats, measure, units[measure], accounted)
        yield _name_of(measure), "every animal, and the difference", drawn
    wanted = [name for name in OF_STUDY if name in only]
    if sessions and wanted:
        yield from _of_many(_grouped(sessions, table), wanted, list(stats["reference"])[:1])


def _of_many(
    animals: Sequence[SessionAnimal], only: Sequence[str], reference: Sequence[str] = ()
) -> Iterator[Drawn]:
    groups_in_order = [*reference, *references_first(animal.group for animal in animals)]
    animals = sorted(animals, key=lambda animal: groups_in_order.index(animal.group))
    for name in only or OF_STUDY:
        what, draw = OF_STUDY[name]
        yield name, what, draw(animals)


def _name_of(measure: str) -> str:
    """The name of a comparison's figure of a measure."""
    return durable.safe_name(f"compare_{measure}")


def remove_others(folder: Path, measures: Sequence[str]) -> None:
    """Remove figures of measures that are no longer compared.

    Args:
        folder: the folder of a comparison's figures.
        measures: the compared measures.
    """
    kept = {_name_of(measure) for measure in measures}
    for path in _files(folder):
        if path.name.startswith("compare_") and path.stem not in kept:
            path.unlink()


def write_figures(
    drawn: Iterator[Drawn], folder: Path, kinds: Sequence[str], progress: Progress = silent
) -> tuple[list[Path], list[str]]:
    """Write figures as files, each complete or not at all.

    Args:
        drawn: the figures, drawn one by one.
        folder: created if missing.
        kinds: some of `KINDS`.
        progress: reports the number of the figure.

    Returns:
        The files, and the names of the figures with nothing to draw.
    """
    files: list[Path] = []
    empty: list[str] = []
    alone = [kind for kind in kinds if kind != PAGES]
    with drawing(), _one_pdf(folder if PAGES in kinds else None) as pages:
        for k, (name, _, figure) in enumerate(drawn):
            progress(k, None, "drawing figures")
            if figure is None:
                empty.append(name)
                continue
            for kind in alone:
                files.append(put_figure(folder, f"{name}.{kind}", image_bytes(figure, kind)))
            if pages is not None:
                pages.savefig(figure)
    if PAGES in kinds and (folder / _PAGES_FILE).is_file():
        files.append(folder / _PAGES_FILE)
    return files, empty


@contextmanager
def _one_pdf(folder: Path | None) -> Iterator[PdfPages | None]:
    """All figures of a folder as one PDF, written at the end of the block; None if no folder.

    The font is embedded once: separate PDFs take several times as long.
    """
    if folder is None:
        yield None
        return
    held = io.BytesIO()
    with PdfPages(held, metadata={"CreationDate": None}) as pages:
        yield pages
        n_pages = pages.get_pagecount()
    if n_pages:
        put_figure(folder, _PAGES_FILE, held.getvalue())


def put_figure(folder: Path, name: str, content: bytes) -> Path:
    """Write one file of a figure under another name and rename it; returns its path.

    Args:
        folder: the folder of figures, created if missing.
        name: of the file.
        content: its bytes.

    Raises:
        PlaceError: the path is a symbolic link.
    """
    durable.unlinked(folder).mkdir(parents=True, exist_ok=True)
    place = durable.inside(folder, Path(name).stem, Path(name).suffix)
    with durable.replacing(place) as part:
        part.write_bytes(content)
    return place


def read_comparison(folder: Path) -> tuple[pd.DataFrame, pd.DataFrame, list[Session]]:
    """The output of `liex compare`: table of sessions, table `stats`, and the opened sessions.

    A session that is missing from its path is left out. `attrs` of the sessions' table contains the
    sentence on included and excluded sessions.

    Args:
        folder: the folder of the comparison.

    Raises:
        SessionError: its files are missing or damaged.
    """
    with expecting(
        SessionError,
        f"{folder} should hold what `liex compare` writes",
        OSError,
        ValueError,
        KeyError,
        TypeError,
        advice="compare again",
    ):
        table = text_files.read_harmless(
            folder / "sessions.csv", ("session_id", "individual", *SUBJECT)
        )
        stats = pd.read_parquet(folder / "stats.parquet")
        document = json.loads((folder / COMPARISON_FILE).read_text(encoding="utf-8"))
        places = [folder / str(place) for place in document["sessions"]]
        table.attrs["accounted"] = str(document.get("accounted", ""))
        if "n_units_first" in stats:  # written by an earlier version
            ends = stats["contrast"].str.rpartition(" - ")
            stats = stats.rename(
                columns={"n_units_first": "n_reference", "n_units_second": "n_group"}
            ).assign(group=ends[0], reference=ends[2])
    return table, stats, [Session.open(p) for p in places if (p / "session.json").is_file()]


def check_names(only: Sequence[str], known: Sequence[str]) -> None:
    """Refuse unknown names of figures.

    Args:
        only: the requested names.
        known: the existing names.

    Raises:
        SessionError: a name is unknown.
    """
    for name in (one for one in only if one not in known):
        hint = did_you_mean(name, known)
        raise SessionError(f"there is no figure '{name}' here: {hint}known are {', '.join(known)}")


def for_the_page(session: Session, folder: Path | None) -> dict[str, str]:
    """Every figure of a session as an element of a page, by name; also written as SVG.

    Other formats are written if the plan requests them (`[report] figures`). Existing files are
    drawn again, because a correction may have changed the session.

    Args:
        session: the opened session.
        folder: of the files; None writes none.
    """
    made: dict[str, str] = {}
    there = set() if folder is None else {path.name for path in _files(folder)}
    report = session.metadata.get("plan", {}).get("report", {})  # older plans have none
    asked = {str(kind) for kind in report.get("figures", ())}
    paged = PAGES in asked or _PAGES_FILE in there
    with drawing(), _one_pdf(folder if paged else None) as pages:
        for name, what, figure in session_figures(session):
            memory.release_memory()
            if figure is None:
                continue
            svg = image_bytes(figure, "svg")
            made[name] = on_page(svg, name, f"{name.replace('_', ' ')}: {what}")
            if folder is None:
                continue
            for kind in FORMATS:
                if kind == "svg" or kind in asked or f"{name}.{kind}" in there:
                    put_figure(
                        folder,
                        f"{name}.{kind}",
                        svg if kind == "svg" else image_bytes(figure, kind),
                    )
            if pages is not None:
                pages.savefig(figure)
    if folder is not None and made:
        for old in _files(folder):  # without a figure any more
            if old.stem.split("-")[0] in OF_SESSION and old.stem not in made:
                old.unlink()
    return made


def _files(folder: Path) -> list[Path]:
    """The figure files in a folder, in the order of their names."""
    return sorted(path for kind in FORMATS for path in folder.glob(f"*.{kind}"))


def _arena(session: Session) -> Figure | None:
    """The arena from some frames of the session's replay; None without depth."""
    n = len(session.frames) if keeps_depth(session) else 0
    # nine frames, for the empty arena
    rows = np.unique(np.linspace(0, max(n - 1, 0), 9).astype(int)) if n else ()
    with closing(DepthImages()) as images:
        found = [images.depth(session, int(row)) for row in rows]
    return places.arena_map(session, [image for image in found if image is not None])


def _grouped(sessions: Sequence[Session], table: pd.DataFrame) -> list[SessionAnimal]:
    """The animals with their groups in a comparison; animals without a group are left out."""
    keys = ["session_id", "individual"]
    named = table.astype(dict.fromkeys(keys, str)).groupby(keys)["group"]
    stated = {key: list(groups_of) for key, groups_of in named}
    every = [animal for session in sessions for animal in session_animals(session)]
    there = Counter((animal.session.name, animal.individual) for animal in every)
    found = []
    for animal in every:
        key = animal.session.name, animal.individual
        own = stated.get(key, [])
        # rows of sessions with one name, in several folders, are in the sessions' order; if one
        # of them is missing, the rows cannot be assigned
        if len(own) == there[key] or len(set(map(str, own))) == 1:
            group = own[0] if len(own) == 1 else own.pop(0)
            there[key] -= 1
            if isinstance(group, str) and group:
                found.append(replace(animal, group=group))
    return found
