"""The dashboard's form for manual corrections: flip of a span, joint of a frame, bout.

Corrections lie beside the session, never over it; `liex_lab.sessions.correcting` makes them.
"""

from __future__ import annotations

from typing import Any

from dash import ALL, Dash, Input, Output, State, ctx, dcc, html, no_update

from liex_lab.errors import LiexError, SessionError
from liex_lab.sessions import Session, correcting
from liex_lab.sessions.corrections import Correction, author_name, read_log

from .data import StudyData
from .parts import aria
from .saver import Saver

_DEEDS = (
    ("flip", "Exchange head and tail in the span"),
    ("rename", "Rename the bout at this moment"),
    ("recut", "Cut that bout to the span"),
    ("delete", "Delete that bout"),
    ("add", "Add a bout in the span"),
    ("pixel", "Put it under the pixel"),
    ("place", "Put it at the place"),
)
_PLACE = ("u", "v", "x", "y", "z")


def panel(session: Session) -> html.Details:
    """The form, closed until it is wanted, and the corrections that were made.

    Args:
        session: the opened session.
    """
    titles = dict(_DEEDS)

    def do(what: str) -> html.Button:
        """The button of the correction `what`."""
        return html.Button(
            titles[what], id={"part": "correct", "what": what}, n_clicks=0, type="button"
        )

    def field(name: str, title: str) -> html.Label:
        """A field for the number `name`, headed `title`."""
        return html.Label(
            [html.Span(title), dcc.Input(id=f"correct-{name}", type="number", step="any")]
        )

    def choice(name: str, title: str, options: Any) -> html.Label:
        """A list of `options` for the entry `name`, headed `title`."""
        chooser = dcc.Dropdown(id=f"correct-{name}", options=options, placeholder="choose")
        return html.Label([html.Span(title), chooser])

    here = [
        html.Button(f"{word} here", id=f"correct-{word}-here", n_clicks=0, type="button")
        for word in ("from", "to")
    ]
    return html.Details(
        id="correct",
        className="correct",
        children=[
            html.Summary("Correct by numbers, and what was corrected"),
            html.P(
                "Corrections lie beside the session, never over it, and are applied whenever it "
                "is read.",
                className="muted",
            ),
            _row(
                "a span of time",
                field("from", "Span from, s"),
                here[0],
                field("to", "to, s"),
                here[1],
                do("flip"),
            ),
            _row(
                "bouts",
                choice("action", "Action", _options(session)),
                html.Label([html.Span("or a new word"), dcc.Input(id="correct-new", type="text")]),
                do("rename"),
                do("recut"),
                do("delete"),
                do("add"),
            ),
            html.P(
                "A click on the picture fills in the pixel for the joint that is chosen here.",
                className="muted",
            ),
            _row(
                "a joint by its pixel",
                choice(
                    "joint", "Joint", [str(name) for name in session.metadata["animal"]["joints"]]
                ),
                field("u", "pixel u"),
                field("v", "v"),
                do("pixel"),
            ),
            _row(
                "a joint by its place",
                field("x", "Place x, mm"),
                field("y", "y"),
                field("z", "z"),
                do("place"),
            ),
            _row(
                "who",
                html.Label(
                    [
                        html.Span("Made by"),
                        dcc.Input(id="correct-by", type="text", value=author_name()),
                    ]
                ),
            ),
            html.P(id="correct-said", className="problems", role="alert", hidden=True),
            html.Div(made(session), id="correct-made"),
        ],
    )


def _options(session: Session) -> list[dict[str, str]]:
    """The words that a bout may get, as a list to choose from."""
    words = list(session.metadata.get("actions") or {})
    return [{"label": word.replace("_", " "), "value": word} for word in words]


def _row(name: str, *parts: Any) -> html.Div:
    return html.Div(list(parts), className="tools", role="group", **aria(label=name))


def made(session: Session) -> html.Div:
    """The corrections that stand, each with a button that takes it back.

    Args:
        session: the opened session.
    """
    log = read_log(session.path)
    again = [
        html.Button(
            f"Redo: {what}", id={"part": "undo", "number": number}, n_clicks=0, type="button"
        )
        for number, what in [log.redoable or (0, None)]
        if number
    ]
    if not log.standing:
        return html.Div([html.P("No corrections so far.", className="muted"), *again])
    lines = [
        html.Li(
            [
                f"{entry.number}: {entry.what} ({entry.author}, {entry.made_at}) ",
                html.Button(
                    "Take back",
                    id={"part": "undo", "number": entry.number},
                    n_clicks=0,
                    type="button",
                ),
            ]
        )
        for entry in log.standing
    ]
    return html.Div([html.H3("Corrections"), html.Ul(lines, className="made"), *again])


def asked_for(session: Session, what: str, at_s: float, told: dict[str, Any]) -> Correction:
    """The correction that a button asks for, with what stands in the form.

    Args:
        session: the opened session.
        what: flip, rename, recut, delete, add, pixel or place.
        at_s: the moment that the page shows, s since the first frame.
        told: from, to (s), action, new (an action that the ethogram has no word for), joint, u, v
            (px), x, y, z (mm, arena frame).

    Raises:
        SessionError: what stands in the form is not enough, or too much.
    """

    def number(*names: str) -> list[float]:
        """Numbers of the fields `names`; raises SessionError where one is missing."""
        missing = [name for name in names if not isinstance(told.get(name), int | float)]
        if missing:
            raise SessionError(
                f"this needs a number in each of {', '.join(names)}; fill in {', '.join(missing)}"
            )
        return [float(told[name]) for name in names]

    def word(name: str) -> str:
        """Text of the field `name`; raises SessionError where it is empty."""
        if not told.get(name):
            raise SessionError(f"this needs the {name}; choose one")
        return str(told[name])

    def action() -> tuple[str, bool]:
        """The action, and whether its word is new; raises SessionError where both are filled in."""
        new = str(told.get("new") or "").strip()
        if new and told.get("action"):
            raise SessionError(
                f"this needs one action, got {told['action']} and the new word {new}; empty one of "
                "them"
            )
        return (new, True) if new else (word("action"), False)

    if what in ("rename", "add"):
        name, new_word = action()
        if what == "rename":
            return correcting.rename_bout(session, at_s, name, new_word=new_word)
        return correcting.add_bout(session, name, *number("from", "to"), new_word=new_word)
    if what == "flip":
        return correcting.flip_span(session, *number("from", "to"))
    if what == "recut":
        return correcting.recut_bout(session, at_s, *number("from", "to"))
    if what == "delete":
        return correcting.delete_bout(session, at_s)
    frames = session.frames
    frame = int(
        frames["frame_index"].iloc[int((frames["time_s"] - at_s).abs().to_numpy().argmin())]
    )
    if what == "pixel":
        return correcting.joint_move_at_pixel(session, frame, word("joint"), *number("u", "v"))
    return correcting.joint_move(session, frame, word("joint"), number("x", "y", "z"))


def register(app: Dash, data: StudyData, saver: Saver) -> None:
    """Register what happens in the form.

    Args:
        app: the dashboard.
        data: the study.
        saver: saves corrections, one after the other.
    """
    names = ("from", "to", "action", "new", "joint", *_PLACE)

    @app.callback(
        Output("corrections-made", "data", allow_duplicate=True),
        Output("correct-said", "children"),
        Output("correct-said", "hidden"),
        Output("correct-action", "options"),
        Output("correct-action", "value"),
        Output("correct-new", "value"),
        Input({"part": "correct", "what": ALL}, "n_clicks"),
        Input({"part": "undo", "number": ALL}, "n_clicks"),
        State("moment", "value"),
        State("session-key", "data"),
        State("correct-by", "value"),
        *(State(f"correct-{name}", "value") for name in names),
        running=[(Output("correct", "className"), "correct busy", "correct")],
        prevent_initial_call=True,
    )
    def do(
        _deeds: Any, _undone: Any, at_s: float | None, key: str, by: str | None, *values: Any
    ) -> Any:
        """Make or take back a correction, and let the page follow; or say what is wrong.

        Args:
            _deeds: numbers of clicks on the buttons of corrections.
            _undone: numbers of clicks on the buttons that take one back.
            at_s: the moment that the page shows, s.
            key: the session's name in the study.
            by: who corrects.
            *values: what stands in the form's fields.
        """
        asked = ctx.triggered_id
        if not isinstance(asked, dict) or not ctx.triggered[0]["value"]:
            return (no_update,) * 6
        moment = float(at_s or 0.0)
        try:
            session = data.session(key)
            if asked["part"] == "undo":
                ticket = saver.take_back(session.path, int(asked["number"]), by or "")
            else:
                told = dict(zip(names, values, strict=True))
                what = asked_for(session, asked["what"], moment, told)
                ticket = saver.add(session.path, what, by or "")
            saver.wait(ticket)
        except LiexError as error:
            return no_update, str(error), False, *(no_update,) * 3
        made_now = f"{len(read_log(session.path).entries)} by numbers"
        return made_now, "", True, _options(data.session(key)), None, ""

    for word in ("from", "to"):

        @app.callback(
            Output(f"correct-{word}", "value"),
            Input(f"correct-{word}-here", "n_clicks"),
            State("moment", "value"),
            prevent_initial_call=True,
        )
        def here(n_clicks: int, at_s: float | None) -> Any:
            return at_s if n_clicks else no_update
