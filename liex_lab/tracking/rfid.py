"""RFID readings as evidence of identity: which tag was read at which antenna, and when.

A reading at an antenna with the range r has, for the animal whose body's centre is at the distance
d from it, the likelihood

    e + (1 - e) exp(-max(d - r, 0)^2 / (2 s^2)),    s: half the animal's length,

because the tag is somewhere in the body; e is the share of wrong readings. A tag that is not read
is no evidence: animals pass antennas unread.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from liex_lab.arrays import Array, NDArray
from liex_lab.errors import LiexError, expecting, refuse
from liex_lab.plan.sections import Rfid
from liex_lab.runtime.text_files import number, read_texts
from liex_lab.scene.scene import Arena

Numbers = NDArray[np.int64]

_COLUMNS = ("time_s", "antenna", "id")
# share of wrong readings: 1.0 to 1.3 % of the passages at 80 antennas were misread (König et al.
# 2015, Animal Biotelemetry 3:39)
_MISREAD = 0.01
_AT_ONCE_S = 0.1  # between readings of two tags at one antenna that contradict each other
_STAY_S = 1.0  # within which readings of a tag at an antenna are one
_NEAR_S = 0.5  # of a reading from a frame that shows all animals


@dataclass(frozen=True)
class Readings:
    """The readings of a recording that are evidence.

    Attributes:
        tags: the tags of the animals.
        tag: (r,) which of them was read.
        time_s: (r,) s since the first frame.
        antenna_mm: (r, 3) x, y and range of the antenna, arena frame.
        remarks: sentences on readings that are left out.
    """

    tags: tuple[str, ...]
    tag: Numbers
    time_s: Array
    antenna_mm: Array
    remarks: tuple[str, ...] = ()

    def costs(
        self, seconds: Array, places: Array, length_mm: float
    ) -> tuple[Numbers, Numbers, Array]:
        """Cost of each reading if the tag is carried by the animal at each place.

        Args:
            seconds: (m,) times of the frames that show all animals, s.
            places: (m, N, 2) centres of the N animals in them, mm.
            length_mm: length of an animal.

        Returns:
            For each reading near such a frame the number of its tag, the frame (k,), and the costs
            (k, N), nats.
        """
        row = np.abs(seconds - self.time_s[:, None]).argmin(axis=1)
        near = np.abs(seconds[row] - self.time_s) <= _NEAR_S
        away = np.linalg.norm(places[row] - self.antenna_mm[:, None, :2], axis=-1)
        beyond = np.maximum(away - self.antenna_mm[:, 2:], 0.0) / (0.5 * length_mm)
        cost = -np.log(_MISREAD + (1.0 - _MISREAD) * np.exp(-0.5 * beyond**2))
        return self.tag[near], row[near], cost[near]


def read_readings(stated: Rfid, last_s: float, n_animals: int, arena: Arena) -> Readings:
    """The readings of a recording, from the file that the plan names.

    Args:
        stated: file, tags and antennas.
        last_s: time of the last frame, s since the first.
        n_animals: how many animals are measured.
        arena: the floor's outline.

    Raises:
        LiexError: the file is not a table of readings in order of time, or none is of this
            recording; an antenna's place is not stated, or outside the arena; or there are more
            tags than animals.
    """
    source = Path(stated.readings)
    with expecting(
        LiexError,
        f"{source} should be a table of RFID readings with the columns {', '.join(_COLUMNS)}, "
        "as CSV",
        OSError,
        ValueError,
    ):
        table = read_texts(source)
        if lacking := ", ".join(name for name in _COLUMNS if name not in table):
            raise ValueError(f"it lacks {lacking}")
        time_s = np.array([float(number(text)) for text in table["time_s"]]) + stated.offset_s
    antenna, tag = (table[name].to_numpy(str) for name in _COLUMNS[1:])
    places = {name: (*one.centre, one.radius) for name, one in stated.antennas.items()}
    unknown = sorted({*antenna} - {*places})
    outside = [
        name for name, one in places.items() if arena.wall_distance_mm(np.array(one[:2])) < -one[2]
    ]
    back = np.flatnonzero(np.diff(time_s) < 0.0) + 3  # lines
    inside = (time_s >= 0.0) & (time_s <= last_s)
    span = f"{time_s[0]:g} to {time_s[-1]:g} s" if len(time_s) else "none"
    refuse(
        LiexError,
        (
            len(stated.tags) > n_animals,
            f"animal.rfid states {len(stated.tags)} tags ({', '.join(stated.tags)}), and "
            f"{n_animals} animals are measured; state the tags of these animals",
        ),
        (
            unknown,
            f"{source} has readings at {', '.join(unknown)}, whose place is not stated; add it to "
            "animal.rfid.antennas",
        ),
        (
            outside,
            f"the antenna {', '.join(outside)} is outside the arena; its place is [x, y] in mm of "
            "the arena frame, as of a region in mm, and its radius is its range",
        ),
        (
            len(back),
            f"readings are in order of time, and line {next(iter(back), 0)} of {source} is earlier "
            "than the one before; were two files joined, or the clock set back?",
        ),
        (
            not inside.any(),
            f"no reading of {source} ({span}) is in the recording (0 to {last_s:.3f} s); times are "
            "s since the first frame: state animal.rfid.offset_s, which `liex sync` can find",
        ),
    )
    known = np.isin(tag, stated.tags)
    order = np.lexsort((time_s, antenna))
    both = (antenna[order][1:] == antenna[order][:-1]) & (tag[order][1:] != tag[order][:-1])
    both &= np.diff(time_s[order]) < _AT_ONCE_S
    twice = np.zeros(len(tag), np.bool_)
    twice[order[1:][both]] = twice[order[:-1][both]] = True
    remarks = (
        ((~inside).sum(), "are outside the recording (check animal.rfid.offset_s)"),
        ((~known).sum(), f"are of other tags ({', '.join(sorted({*tag[~known]})[:5])})"),
        (twice.sum(), "are of two tags at one antenna at once"),
    )
    used = table.assign(second=time_s // _STAY_S)[inside & known & ~twice]
    rows = used.drop_duplicates(["antenna", "id", "second"]).index.to_numpy()
    return Readings(
        tuple(stated.tags),
        np.array([stated.tags.index(tag[row]) for row in rows], np.int64),
        time_s[rows],
        np.array([places[antenna[row]] for row in rows], float).reshape(-1, 3),
        tuple(f"{n} of {len(tag)} RFID readings {why}, and left out" for n, why in remarks if n),
    )
