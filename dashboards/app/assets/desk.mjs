// The page to correct in: picture, bands of time and panel, keys and mouse. Every text is set as text, never as markup.

import { Player, SPEEDS } from "./desk_player.mjs";
import { Source, json } from "./desk_source.mjs";
import { Stage } from "./desk_stage.mjs";
import { Strip } from "./desk_strip.mjs";

const ASK_MS = 250;  // how often it is asked whether all is saved
const TOLD_MS = 160;  // the page's other figures follow when the moment has stood so long
const KEYS = [
  ["space", "play or pause"], ["← →", "one frame; with Shift one second"], ["↑ ↓", "bout before, bout after"],
  [", .", "slower, faster"], ["1 to 9", "name the bout here, or the marked span; with Shift from the tenth on"], ["0", "take the bout's name away"],
  ["[ ]", "mark a span from here, to here; Esc clears it"], ["F", "exchange head and tail in the span, or here"],
  ["N P", "next, previous place in doubt"], ["K", "it is right as it is: next"], ["U", "take back"],
  ["+ − Z", "zoom in, out; all of the picture"], ["S", "skeleton on, off"],
];

export function make(name, attributes, ...inside) {
  const made = document.createElement(name);
  Object.entries(attributes || {}).forEach(([key, value]) => {
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (value !== undefined && value !== false) made.setAttribute(key, value === true ? "" : value);
  });
  made.append(...inside);
  return made;
}

export function button(text, title, act, more) {
  return make("button", { type: "button", title, onclick: act, ...more }, text);
}

export function typing(event) {  // a key that belongs to a field or a list, not to the page
  const at = event.target;
  if (event.ctrlKey || event.metaKey || event.altKey || event.defaultPrevented) return true;
  if (at.closest && at.closest("input, textarea, select, [contenteditable], [role=listbox], [role=combobox], .dash-dropdown, .js-plotly-plot")) return true;
  return [" ", "Enter"].includes(event.key) && Boolean(at.closest && at.closest("button, a, summary"));
}

let open = null;

export async function start(key, at) {  // the page of a session has been opened
  if (open) open.close();
  const place = document.getElementById("desk");
  if (!place) return;
  const desk = open = new Desk(place, key);
  try {
    await desk.begin(at);
  } catch (error) {
    place.replaceChildren(make("p", { class: "problems", role: "alert" }, error.message));
  }
}

export function moment(at) {  // somebody chose another moment elsewhere on the page
  if (open && open.player && at !== null && at !== undefined) open.hear(Number(at));
}

export function again(made) {  // something was corrected in the form below
  if (open && open.player && open.made !== made) open.refresh();
}

export function drawn(row, joint, scale = false) {  // where a joint is on the canvas, CSS pixels; or pixels for one of the picture
  const { stage } = open, dots = stage.canvas.width / stage.canvas.getBoundingClientRect().width;
  if (scale) return stage.view.scale / dots;
  const seen = stage.source.at(row), uv = seen && seen.animals[0].uv;
  return uv && stage.at(...uv[joint]).map((one) => one / dots);
}

class Desk {
  constructor(place, key) {
    this.key = key;
    this.place = place;
    this.source = new Source(`/desk/${encodeURIComponent(key)}`);
    this.span = [null, null];
    this.tickets = [];
    this.mine = [];  // what this visit did, to be taken back by U
    this.doubts = [];
    this.bouts = [];
    this.doubt = -1;
    this.keep = `liex-looked-${key}`;
    this.looked = new Set(JSON.parse(sessionStore(this.keep) || "[]"));
    this.press = (event) => this.key_(event);
    this.leave = (event) => { if (this.unsaved) event.preventDefault(); };
    this.unsaved = 0;
  }

  close() {
    document.removeEventListener("keydown", this.press);
    window.removeEventListener("beforeunload", this.leave);
    if (this.player) this.player.closed = true;
    clearTimeout(this.asking);
  }

  async begin(at) {
    const about = await this.source.open();
    this.about = about;
    this.actions = about.actions;
    this.build();
    this.stage = new Stage(this.canvas, this.source);
    this.player = new Player(this.source, this.stage);
    this.stage.onPlaceable = () => about.may_correct;
    this.stage.onPlace = (row, joint, to) => this.placeJoint(row, joint, to);
    this.stage.onPick = (pixel) => ["u", "v"].forEach((name, k) => set(`correct-${name}`, { value: Math.round(pixel[k] * 100) / 100 }));
    this.player.shown = (row) => this.show(row);
    this.player.stopped = () => this.tell();
    this.strips.forEach((strip) => {
      strip.duration = about.duration_s;
      strip.colours = new Map(about.actions.map((one) => [one.word, one.colour]));
      strip.go = (time) => { this.player.play(false); this.player.go(this.source.rowAt(time)); };
      strip.mark = (from, to) => this.markSpan(from, to);
    });
    document.addEventListener("keydown", this.press);
    window.addEventListener("beforeunload", this.leave);
    this.player.go(this.source.rowAt(at));
    this.readBouts().then(() => this.readDoubts()).then(() => about.may_correct && this.ask())
      .catch((error) => this.say(error.message, true));
    await this.stage.first;
  }

  build() {
    const may = this.about.may_correct;
    this.canvas = make("canvas", { class: "desk-stage", tabindex: "0", role: "img",
      "aria-label": "depth picture as height above the floor, with the skeleton; keys are listed beside it" });
    this.playButton = button("▶ Play", "space", () => this.player.play(!this.player.playing), { class: "main desk-play" });
    this.speed = make("select", { "aria-label": "speed of playing", onchange: (event) => {
      this.player.speed = Number(event.target.value);
      this.canvas.focus({ preventScroll: true });
    } }, ...SPEEDS.map((one) => make("option", { value: one, selected: one === 1 }, `${one}×`)));
    this.clock = make("output", { class: "desk-clock" });
    const bands = [make("canvas", { class: "desk-near", "aria-hidden": "true" }), make("canvas", { class: "desk-all", "aria-hidden": "true" })];
    this.strips = [new Strip(bands[0], true), new Strip(bands[1], false)];
    const bar = make("div", { class: "desk-bar" }, this.playButton, this.speed,
      button("−", "zoom out (−)", () => { this.stage.zoom(0.8); this.player.wake(); }, { "aria-label": "zoom out" }),
      button("+", "zoom in (+)", () => { this.stage.zoom(1.25); this.player.wake(); }, { "aria-label": "zoom in" }),
      this.viewButton = button("Whole picture", "Z", () => this.view()), this.clock);
    this.now = make("p", { class: "desk-now" });
    this.said = make("p", { class: "desk-said", role: "status" });
    this.saved = make("p", { class: "muted desk-saved", role: "status" });
    this.names = make("div", { class: "desk-actions", role: "group", "aria-label": "name the bout, or the marked span" },
      ...this.actions.map((one, k) => {
        const swatch = make("i", {});
        swatch.style.background = one.colour;
        return button("", keyOf(k) ? `key ${keyOf(k)}` : "", () => this.name(one.word), { disabled: !may, "data-word": one.word });
      }));
    [...this.names.children].forEach((made, k) => {
      const swatch = make("i", {});
      swatch.style.background = this.actions[k].colour;
      made.append(make("kbd", {}, keyOf(k) || " "), swatch, this.actions[k].title);
    });
    const deeds = make("div", { class: "desk-bar" },
      button("No name", "0", () => this.correct({ what: "nothing", at_s: this.time() }), { disabled: !may }),
      button("Head ⇄ tail", "F", () => this.flip(), { disabled: !may }),
      button("[ from", "[", () => this.mark(0)), button("to ]", "]", () => this.mark(1)),
      button("Take back", "U", () => this.undo(), { disabled: !may }));
    this.list = make("ol", { class: "desk-doubts" });
    this.count = make("span", { class: "muted" });
    const side = make("div", { class: "desk-side" }, this.now,
      make("h3", {}, "What it does"), this.names, deeds, this.said, this.saved,
      make("h3", {}, "Places in doubt ", this.count),
      make("div", { class: "desk-bar" }, button("◀", "P", () => this.nextDoubt(-1), { "aria-label": "previous place in doubt" }),
        button("Next in doubt", "N", () => this.nextDoubt(1), { class: "main" }),
        button("Right as it is", "K", () => this.right())),
      this.list,
      make("details", { class: "desk-keys" }, make("summary", {}, "Keys and mouse"),
        make("p", { class: "muted" }, "Drag a joint to put it elsewhere; drag the picture to move it. Drag over the upper band to mark a span."),
        make("dl", {}, ...KEYS.flatMap(([name, does]) => [make("dt", {}, make("kbd", {}, name)), make("dd", {}, does)]))));
    this.place.replaceChildren(make("div", { class: "desk-left" }, this.canvas, bar, ...bands), side);
    this.place.addEventListener("click", (event) => {  // after a click the keys are the page's again
      if (event.detail && event.target.closest("button")) this.canvas.focus({ preventScroll: true });
    });
  }

  time() { return this.source.times[this.player.row]; }

  show(row) {
    const time = this.source.times[row];
    this.strips.forEach((strip) => { strip.now = time; strip.paint(); });
    this.playButton.textContent = this.player.playing ? "❚❚ Pause" : "▶ Play";
    if (Number(this.speed.value) !== this.player.speed) this.speed.value = String(this.player.speed);
    this.clock.textContent = `${time.toFixed(3)} s of ${this.about.duration_s.toFixed(1)} s`;
    const seen = this.source.at(row), bout = this.boutAt(time);
    const facts = [bout ? bout.action.replaceAll("_", " ") : "no name"];
    if (seen && seen.flag) facts.push(seen.flag.replaceAll("_", " "));
    if (seen && seen.error !== null) facts.push(`error ${seen.error.toFixed(1)} mm`);
    if (seen) facts.push(`frame ${seen.frame}`);
    this.now.textContent = facts.join(" · ");
    [...this.names.children].forEach((one) => one.classList.toggle("is-now", Boolean(bout) && bout.action === one.dataset.word));
    if (!this.player.playing) this.tell();
  }

  tell() {  // the page's other figures follow, once the moment stands
    clearTimeout(this.telling);
    this.telling = setTimeout(() => {
      if (this.player.playing || this.player.closed) return;
      this.heard = Number(this.time().toFixed(4));
      set("moment", { value: this.heard });
    }, TOLD_MS);
  }

  hear(at) {
    if (this.heard !== undefined && Math.abs(at - this.heard) < 1e-6) return;
    clearTimeout(this.telling);
    this.player.play(false);
    clearTimeout(this.telling);
    this.player.go(this.source.rowAt(at));
  }

  boutAt(time) { return this.bouts.find((one) => one.start_s <= time + 5e-4 && time + 5e-4 < one.stop_s); }

  async readBouts() {
    this.bouts = await json(`${this.source.base}/bouts`);
    this.strips.forEach((strip) => { strip.bouts = this.bouts; });
    const known = new Set(this.actions.map((one) => one.word));
    if (this.bouts.some((one) => !known.has(one.action))) {  // a new word was given
      const about = await json(`${this.source.base}/about`);
      this.strips.forEach((strip) => { strip.colours = new Map(about.actions.map((one) => [one.word, one.colour])); });
    }
    this.show(this.player.row);
  }

  async readDoubts() {
    const poses = await json(`${this.source.base}/doubts`);
    this.setDoubts(poses);
    json(`${this.source.base}/doubts?of=actions`).then((actions) => {
      if (!this.player.closed) this.setDoubts([...poses, ...actions].sort((a, b) => a.start_s - b.start_s));
    }, () => {});
  }

  setDoubts(found) {
    const now = this.doubts[this.doubt];
    this.doubts = found.map((one) => ({ ...one, done: this.looked.has(nameOf(one)) }));
    this.doubt = now ? this.doubts.findIndex((one) => nameOf(one) === nameOf(now)) : -1;
    this.strips.forEach((strip) => { strip.doubts = this.doubts; strip.paint(); });
    this.list.replaceChildren(...this.doubts.map((one, k) => make("li", {},
      button("", "look at this place", () => this.goDoubt(k), { class: "link" }))));
    [...this.list.children].forEach((line, k) => {
      line.firstChild.append(make("b", {}, `${this.doubts[k].start_s.toFixed(2)} s `), this.doubts[k].why);
    });
    this.tellDoubts();
  }

  tellDoubts() {
    const left = this.doubts.filter((one) => !one.done).length;
    this.count.textContent = this.doubts.length ? `${left} of ${this.doubts.length} left` : "none";
    [...this.list.children].forEach((line, k) => {
      line.classList.toggle("is-done", this.doubts[k].done);
      line.classList.toggle("is-now", k === this.doubt);
    });
    this.strips.forEach((strip) => strip.paint());
    const here = this.list.children[this.doubt];
    if (here) this.list.scrollTop = Math.max(0, here.offsetTop - this.list.offsetTop - 40);
  }

  goDoubt(k) {
    this.doubt = k;
    const one = this.doubts[k];
    this.player.play(false);
    this.player.go(this.source.rowAt((one.start_s + one.stop_s) / 2));
    this.say(`${one.start_s.toFixed(2)} to ${one.stop_s.toFixed(2)} s: ${one.why}`);
    this.tellDoubts();
  }

  nextDoubt(way) {
    const n = this.doubts.length, time = this.time();
    if (!n) { this.say("no place is in doubt"); return; }
    const from = this.doubt >= 0 ? this.doubt : way > 0 ? this.doubts.findIndex((one) => one.start_s >= time) - 1
      : this.doubts.filter((one) => one.stop_s <= time).length;
    for (let k = 1; k <= n; k += 1) {
      const next = (((from + way * k) % n) + n) % n;
      if (!this.doubts[next].done) { this.goDoubt(next); return; }
    }
    this.say("all places in doubt have been looked at");
  }

  right() {
    const one = this.doubts[this.doubt];
    if (!one) { this.say("go to a place in doubt first, with N"); return; }
    this.worked(one);
    this.nextDoubt(1);
  }

  worked(one) {
    one.done = true;
    this.looked.add(nameOf(one));
    sessionStore(this.keep, JSON.stringify([...this.looked]));
    this.tellDoubts();
  }

  view() {
    if (this.stage.follow) this.stage.whole(); else this.stage.fit();
    this.viewButton.textContent = this.stage.follow ? "Whole picture" : "Go with the animal";
    this.player.wake();
  }

  mark(which) {
    const at = [...this.span];
    at[which] = this.time() + (which ? this.about.frame_s : 0);
    if (at[0] !== null && at[1] !== null && at[1] <= at[0]) at[1 - which] = null;
    this.markSpan(...at);
  }

  markSpan(from, to) {
    this.span = [from, to];
    this.strips.forEach((strip) => { strip.span = this.span; strip.paint(); });
    const told = (value) => (value === null ? null : Math.round(value * 1000) / 1000);
    set("correct-from", { value: told(from) });
    set("correct-to", { value: told(to) });
    if (from !== null && to !== null) this.say(`marked ${from.toFixed(2)} to ${to.toFixed(2)} s`);
    else if (from !== null || to !== null) this.say(`marked ${from !== null ? `from ${from.toFixed(2)}` : `to ${to.toFixed(2)}`} s`);
  }

  marked() {
    const [from, to] = this.span;
    return from !== null && to !== null ? { from_s: Number(from.toFixed(4)), to_s: Number(to.toFixed(4)) } : {};
  }

  name(word) { return this.correct({ what: "action", word, at_s: this.time(), ...this.marked() }); }

  number(k) {
    const action = this.actions[k];
    if (action) return this.name(action.word);
    this.say("no action has this key");
    return null;
  }

  flip() { return this.correct({ what: "flip", at_s: this.time(), ...this.marked() }); }

  placeJoint(row, joint, to) {
    const known = `${row}/${joint}`;
    this.stage.placed.set(known, to);
    return this.correct({ what: "joint", row, joint: this.about.joints[joint], u: to[0], v: to[1] }, known);
  }

  async correct(asked, placed) {
    if (!this.about.may_correct) return;
    const by = document.getElementById("correct-by");
    const here = this.doubts[this.doubt];
    try {
      const told = await this.post({ ...asked, by: by ? by.value : "" });
      this.tickets.push({ ticket: told.ticket, placed });
      this.mine.push(told.ticket);
      this.say(told.said);
      this.markSpan(null, null);
      if (here && here.start_s - 0.5 <= this.time() && this.time() <= here.stop_s + 0.5) this.worked(here);
    } catch (error) {
      if (placed) this.stage.placed.delete(placed);
      this.say(error.message, true);
      this.player.wake();
    }
    this.soon();
  }

  async undo() {
    const ticket = this.mine.pop();
    if (ticket === undefined) {
      this.say("nothing of this visit is left to take back; the list of corrections below has those of before");
      return;
    }
    this.say("taking back …");
    try {
      const told = await this.post({ what: "undo", ticket });
      if (told.ticket !== null) this.tickets.push({ ticket: told.ticket });
      this.say(told.said);
    } catch (error) {
      this.say(error.message, true);
    }
    this.soon();
  }

  post(asked) {
    return json(`${this.source.base}/correct`,
      { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(asked) });
  }

  soon() {
    this.unsaved = Math.max(this.unsaved, 1);
    this.saved.textContent = "saving …";
    clearTimeout(this.asking);
    this.asking = setTimeout(() => this.ask().catch((error) => this.say(error.message, true)), ASK_MS);
  }

  async ask() {  // how far the corrections are
    const state = await json(`${this.source.base}/state`);
    if (this.player.closed) return;
    const done = this.tickets.filter((one) => ["saved", "failed"].includes((state.tickets[one.ticket] || { state: "failed" }).state));
    this.tickets = this.tickets.filter((one) => !done.includes(one));
    this.unsaved = state.unsaved;
    const n = state.log.length;
    this.saved.textContent = state.unsaved ? `saving ${state.unsaved} …`
      : `${n === 1 ? "1 correction stands" : `${n} corrections stand`}, all saved${state.report_old ? "; the report follows" : ""}`;
    const failed = done.map((one) => state.tickets[one.ticket]).find((one) => one && one.state === "failed" && !one.said.startsWith("taken back"));
    if (failed) this.say(failed.said, true);
    if (done.length) {
      await this.refresh();
      done.forEach((one) => one.placed && this.stage.placed.delete(one.placed));
      this.player.wake();
      this.made = `${n}-${Date.now()}`;
      set("corrections-made", { data: this.made });
    }
    if (this.tickets.length || state.unsaved) this.soon();
    else if (state.report_old) this.asking = setTimeout(() => this.ask().catch(() => {}), 1500);
  }

  async refresh() {
    await Promise.all([this.source.forgetRows(), this.readBouts()]);
    this.player.wake();
    this.readDoubts();
  }

  say(text, wrong = false) {
    this.said.textContent = text;
    this.said.classList.toggle("is-wrong", wrong);
  }

  key_(event) {
    if (!this.canvas.isConnected) { this.close(); return; }
    if (typing(event)) return;
    const seconds = (by) => this.source.rowAt(this.time() + by);
    const go = (row) => { this.player.play(false); this.player.go(row); };
    const bout = (way) => {
      const time = this.time(), starts = this.bouts.map((one) => one.start_s);
      const found = way > 0 ? starts.find((one) => one > time + 1e-3) : starts.filter((one) => one < time - 1e-3).pop();
      if (found !== undefined) go(this.source.rowAt(found));
    };
    const acts = {
      " ": () => this.player.play(!this.player.playing),
      ArrowLeft: () => go(event.shiftKey ? seconds(-1) : this.player.row - 1),
      ArrowRight: () => go(event.shiftKey ? seconds(1) : this.player.row + 1),
      ArrowUp: () => bout(-1), ArrowDown: () => bout(1),
      ",": () => this.player.faster(-1), ".": () => this.player.faster(1),
      "[": () => this.mark(0), "]": () => this.mark(1),
      Escape: () => { this.stage.cancel(); this.markSpan(null, null); this.say(""); },
      f: () => this.flip(), u: () => this.undo(), n: () => this.nextDoubt(1), p: () => this.nextDoubt(-1), k: () => this.right(),
      z: () => this.view(), "+": () => this.stage.zoom(1.25), "=": () => this.stage.zoom(1.25), "-": () => this.stage.zoom(0.8),
      s: () => { this.stage.skeleton = !this.stage.skeleton; },
    };
    let act = acts[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    const digit = /^[0-9]$/.test(event.key) ? Number(event.key) : null, code = /^Digit([1-9])$/.exec(event.code);
    if (digit === 0) act = () => this.correct({ what: "nothing", at_s: this.time() });
    else if (digit !== null) act = () => this.number(digit - 1);
    else if (!act && code && event.shiftKey) act = () => this.number(Number(code[1]) + 8);
    if (!act || (event.repeat && !["ArrowLeft", "ArrowRight"].includes(event.key))) return;
    event.preventDefault();
    act();
    this.player.wake();
  }
}

function keyOf(k) { return k < 9 ? String(k + 1) : k < 18 ? `⇧${k - 8}` : ""; }

function nameOf(doubt) { return `${doubt.kind}/${doubt.start_s.toFixed(3)}`; }

function set(id, values) { if (document.getElementById(id) || id === "corrections-made") window.dash_clientside.set_props(id, values); }

function sessionStore(name, value) {  // a browser that keeps nothing still works
  try {
    if (value === undefined) return window.localStorage.getItem(name);
    window.localStorage.setItem(name, value);
  } catch { /* private window */ }
  return null;
}
