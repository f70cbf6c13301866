"""Light and dark, activity by the hour of the day, circadian measures, and sleep by immobility.

Hours are those of the clock, cut where the light is switched. With x_i the activity (distance per
observed time) of the n hours that were observed for at least half, x_h its mean at the hour h of
the day and x its mean (Witting et al. 1990; Van Someren et al. 1999):

    interdaily stability IS = [sum_h (x_h - x)^2 / 24] / [sum_i (x_i - x)^2 / n],
    intradaily variability IV = [mean_i (x_i - x_(i-1))^2] / [sum_i (x_i - x)^2 / n],
    relative amplitude RA = (M10 - L5) / (M10 + L5),

with M10 the mean of the ten successive hours of the mean day that are most active and L5 that of
the five least active ones. The period is the highest peak from 18 to 30 h of the Lomb-Scargle
periodogram (Lomb 1976; Ruf 1999).

Sleep by immobility: a mouse that is immobile for at least 40 s is asleep by EEG with r = 0.94 over
half hours (Pack et al. 2007; Fisher et al. 2012). Immobile is here: body centre, height of the nose
and reach, as means over whole seconds, move by less than `still_mm_s` from second to second. A
second without a measured pose is never immobile.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np
import pandas as pd

from liex_lab.arrays import Array, NDArray
from liex_lab.errors import PlanError
from liex_lab.tables.rows import stop_times
from liex_lab.tables.schema import table_columns, to_pandas

FEWEST_DAYS = 3  # for measures of the regularity and the period of a rhythm
_PERIODS_H = np.arange(18.0, 30.0, 0.05)
_HOUR_S = 3600.0


@dataclass(frozen=True)
class Light:
    """The room's light and the time of day of a recording.

    Attributes:
        start: when the recording began, in the time zone of the light.
        on: when the light is switched on, HH:MM.
        off: when it is switched off, HH:MM.
        immobile_s: least duration of sleep by immobility, s.
        still_mm_s: a slower animal is immobile, mm/s.
    """

    start: datetime
    on: str
    off: str
    immobile_s: float
    still_mm_s: float

    @staticmethod
    def of(stated: Mapping[str, Any], start: str | None) -> "Light | None":
        """The light that a plan states (`[light]`); None if it states none.

        Args:
            stated: the section of the plan.
            start: when the recording began, ISO 8601 with zone.

        Raises:
            PlanError: the start of the recording is unknown.
        """
        if not stated.get("on"):
            return None
        if not start:
            raise PlanError(
                "[light] needs the time of day at which the recording began, which its files do "
                "not state; write it as session.session_start_time, such as "
                "2026-08-21T10:00:00+02:00"
            )
        began = datetime.fromisoformat(start).astimezone(ZoneInfo(stated["zone"]))
        own = {name: stated[name] for name in ("on", "off", "immobile_s", "still_mm_s")}
        return Light(began, **own)

    def is_on(self, moment: datetime) -> bool:
        """Whether the light is on at a moment in its time zone."""
        clock = f"{moment:%H:%M}"
        if self.on < self.off:
            return self.on <= clock < self.off
        return not self.off <= clock < self.on

    def hours(self, duration_s: float) -> tuple[Array, list[datetime], NDArray[np.bool_]]:
        """The hours of the clock in a recording, cut where the light is switched.

        Args:
            duration_s: of the recording.

        Returns:
            Edges (k + 1,), s since the first frame; the time of day at the beginning of each, and
            (k,) whether the light is on.
        """
        began = self.start.timestamp()
        minutes = np.arange(began // 60.0, (began + duration_s) / 60.0) * 60.0
        clock = [datetime.fromtimestamp(t, self.start.tzinfo) for t in minutes]
        lit = [self.is_on(moment) for moment in clock]
        of = [(f"{moment:%j %H %z}", on) for moment, on in zip(clock, lit, strict=True)]
        first = [k for k in range(len(of)) if k == 0 or of[k] != of[k - 1]]
        edges = np.append(np.maximum(minutes[first] - began, 0.0), duration_s)
        starts = [self.start if k == 0 else clock[k] for k in first]
        return edges, starts, np.array([lit[k] for k in first])


def activity_by_hour(kinematics: pd.DataFrame, light: Light, hold: Array) -> pd.DataFrame:
    """The table `hours` of one animal.

    Args:
        kinematics: the table `kinematics`.
        light: the room's light.
        hold: (n,) s, the duration of each frame, 0 without a pose, see `observed_hold`.
    """
    time_s = kinematics["time_s"].to_numpy(float)
    edges, starts, lit = light.hours(float(stop_times(time_s)[-1]))
    n = len(lit)
    row = np.clip(np.searchsorted(edges, time_s, side="right") - 1, 0, n - 1)
    observed = np.bincount(row, hold, n)
    distance = np.bincount(row, np.nan_to_num(kinematics["step_mm"].to_numpy(float)), n)
    asleep = immobile_spans(kinematics, light)
    slept = np.append(0.0, np.cumsum(np.diff(asleep, axis=1).ravel()))
    until = np.interp(edges, np.append(0.0, asleep.ravel()), np.append(0.0, slept.repeat(2)[1:-1]))
    begun = np.searchsorted(edges, asleep[:, 0], side="right") - 1
    return to_pandas(
        table_columns("hours"),
        {
            **{name: [str(kinematics[name].iloc[0])] * n for name in ("session_id", "individual")},
            "start_s": edges[:-1],
            "stop_s": edges[1:],
            "clock": [start.isoformat(timespec="seconds") for start in starts],
            "light": lit,
            "observed_s": observed,
            "distance_mm": distance,
            "mean_speed_mm_s": _ratio(distance, observed),
            "sleep_by_immobility_s": np.diff(until),
            "sleep_by_immobility_count": np.bincount(begun, minlength=n),
        },
    )


def immobile_spans(kinematics: pd.DataFrame, light: Light) -> Array:
    """Starts and stops (k, 2) of the animal's sleep by immobility, s since the first frame."""
    time_s = kinematics["time_s"].to_numpy(float)
    observed = np.isfinite(kinematics["x_mm"].to_numpy(float))
    second = (time_s - time_s[0]).astype(np.int64)[observed]
    n = int(time_s[-1] - time_s[0]) + 1
    count = np.bincount(second, minlength=n)
    count[count < 0.5 * count.max()] = 0
    moved = np.zeros(n - 1)
    for name in ("x_mm", "y_mm", "z_mm", "nose_height_mm", "reach_mm"):
        if name in kinematics:
            values = np.bincount(second, kinematics[name].to_numpy(float)[observed], n)
            moved += np.diff(_ratio(values, count)) ** 2
    still = np.concatenate([[False], moved < light.still_mm_s**2, [False]])
    start, stop = (np.flatnonzero(np.diff(still.astype(int)) == sign) for sign in (1, -1))
    spans = np.column_stack([start, stop + 1]).astype(float)  # from the second it is compared with
    return np.minimum(spans, time_s[-1])[stop + 1 - start >= light.immobile_s]


def rhythm(hours: pd.DataFrame, light: Light) -> pd.DataFrame:
    """The table `rhythm` of one animal: one row.

    Args:
        hours: the table `hours`.
        light: the room's light.
    """
    offset = light.start.utcoffset()
    assert offset is not None
    local_s = hours["start_s"] + light.start.timestamp() + offset.total_seconds()
    rates = _per_hour(hours, (local_s // _HOUR_S).to_numpy(int))
    n_days = float(rates.notna().sum() / 24.0)
    found = _light_and_dark(hours, local_s - 3600.0 * int(light.on[:2]) - 60.0 * int(light.on[3:]))
    refused = []
    profile = rates.groupby(rates.index % 24).mean()
    if len(profile) == 24 and profile.notna().all():
        found |= _amplitude(profile.to_numpy(float))
    else:
        refused.append("M10, L5 and the relative amplitude need every hour of the day")
    if n_days >= FEWEST_DAYS:
        found |= _regularity(rates, profile)
    else:
        refused.append(
            f"stability, variability, period and the interval of the difference between dark and "
            f"light need {FEWEST_DAYS} days, and {n_days:.1f} were observed"
        )
    keys = {name: str(hours[name].iloc[0]) for name in ("session_id", "individual")}
    columns = table_columns("rhythm")
    empty = dict.fromkeys((column.name for column in columns), np.nan)
    whole = {**empty, **found, **keys, "n_days": n_days, "not_measured": "; ".join(refused)}
    return to_pandas(columns, whole)


def _per_hour(hours: pd.DataFrame, hour: NDArray[np.int64]) -> "pd.Series[float]":
    """Activity of successive hours, mm per observed hour; NaN if observed for less than half."""
    total = hours.groupby(hour)[["distance_mm", "observed_s"]].sum()
    total = total.reindex(range(hour[0], hour[-1] + 1))
    rate: pd.Series[float] = _HOUR_S * total["distance_mm"] / total["observed_s"]
    return rate.where(total["observed_s"] >= 0.5 * _HOUR_S)


def _light_and_dark(hours: pd.DataFrame, since_on_s: "pd.Series[float]") -> dict[str, float]:
    """Activity and sleep in light and dark, and the difference with its t interval over days."""
    found = {}
    for name, own in (("light", hours[hours["light"]]), ("dark", hours[~hours["light"]])):
        observed = max(float(own["observed_s"].sum()), 1e-9)
        known = observed > 1.0
        rate = _HOUR_S * own["distance_mm"].sum() / observed
        found[f"{name}_mm_per_h"] = float(rate) if known else np.nan
        share = float(own["sleep_by_immobility_s"].sum()) / observed
        found[f"{name}_sleep_by_immobility_share"] = share if known else np.nan
    found["dark_minus_light_mm_per_h"] = found["dark_mm_per_h"] - found["light_mm_per_h"]
    day = (since_on_s // 86400.0).to_numpy(int)
    total = hours.groupby([day, "light"])[["distance_mm", "observed_s"]].sum()
    total = total[total["observed_s"] >= _HOUR_S]
    by_day = (_HOUR_S * total["distance_mm"] / total["observed_s"]).unstack().dropna()
    if len(by_day) >= FEWEST_DAYS and by_day.shape[1] == 2:
        from scipy.special import stdtrit

        difference = (by_day[False] - by_day[True]).to_numpy(float)
        half = stdtrit(len(by_day) - 1, 0.975) * difference.std(ddof=1) / np.sqrt(len(by_day))
        found["dark_minus_light_mm_per_h"] = float(difference.mean())
        found["dark_minus_light_low_mm_per_h"] = float(difference.mean() - half)
        found["dark_minus_light_high_mm_per_h"] = float(difference.mean() + half)
    return found


def _amplitude(profile: NDArray[Any]) -> dict[str, float]:
    """M10, L5 and the relative amplitude of the mean day, (24,) mm per hour."""
    twice = np.append(0.0, np.cumsum(np.tile(profile, 2)))
    m10, l5 = ((twice[k : k + 24] - twice[:24]) / k for k in (10, 5))
    high, low = float(m10.max()), float(l5.min())
    return {
        "m10_mm_per_h": high,
        "m10_onset_h": float(m10.argmax()),
        "l5_mm_per_h": low,
        "l5_onset_h": float(l5.argmin()),
        "relative_amplitude": (high - low) / (high + low) if high > 0 else np.nan,
    }


def _regularity(rates: "pd.Series[float]", profile: "pd.Series[float]") -> dict[str, float]:
    """Interdaily stability, intradaily variability, and the period."""
    from scipy.signal import lombscargle

    known = rates.dropna()
    x = known.to_numpy(float)
    hour = known.index.to_numpy(float)
    variance = float(x.var())
    if not variance > 0:
        return {}
    power = lombscargle(hour, x - x.mean(), 2.0 * np.pi / _PERIODS_H, normalize=True)
    period = float(_PERIODS_H[power.argmax()])
    return {
        "interdaily_stability": float(((profile.dropna() - x.mean()) ** 2).mean()) / variance,
        "intradaily_variability": float((rates.diff() ** 2).mean()) / variance,
        "period_h": period,
        "period_resolution_h": period**2 / (hour[-1] - hour[0]),
        "period_share": float(power.max()),
    }


def _ratio(values: NDArray[Any], by: NDArray[Any]) -> Array:
    """Quotient (n,); NaN where the divisor is 0."""
    return np.divide(values, by, out=np.full(len(values), np.nan), where=by > 0)
