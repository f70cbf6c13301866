// The correction page: depth image, timelines and panel, keys and mouse. All texts are set as text, never as markup.

import { Clerk } from "./desk_clerk.mjs";
import { Crossings } from "./desk_crossings.mjs";
import { Doubts } from "./desk_doubts.mjs";
import { KEYS, actOf, keyOf, typing } from "./desk_keys.mjs";
import { button, make } from "./desk_parts.mjs";
import { Player, SPEEDS } from "./desk_player.mjs";
import { Source, json } from "./desk_source.mjs";
import { Stage } from "./desk_stage.mjs";
import { Strip } from "./desk_strip.mjs";

const FOLLOW_MS = 160;  // delay before the page's other figures follow the moment

const WHOLE = [0, 0, 1 << 16, 1 << 16];  // clipped to the image

let open = null;

export async function start(key, at, page) {  // the desk; it calls page.moment and page.corrected
  const place = document.getElementById("desk"), desk = open = new Desk(place, key, page);
  try {
    await desk.begin(at);
    place.classList.add("is-open");
  } catch (error) {
    place.replaceChildren(make("p", { class: "problems", role: "alert" }, error.message));
  }
  return desk;
}

export function drawn(row, joint, scale = false) {  // a joint's position on the canvas, CSS pixels; or canvas pixels per image pixel
  const { stage } = open, dots = stage.canvas.width / stage.canvas.getBoundingClientRect().width;
  if (scale) return stage.view.scale / dots;
  const data = stage.source.at(row), uv = data && data.animals[0].uv;
  return uv && stage.at(...uv[joint]).map((one) => one / dots);
}

class Desk {
  constructor(place, key, page) {
    this.key = key;
    this.place = place;
    this.page = page;
    this.source = new Source(`/desk/${encodeURIComponent(key)}`);
    this.span = [null, null];
    this.bouts = [];
    this.clerk = new Clerk(this);
    this.doubts = new Doubts(this);
    this.crossings = new Crossings(this);
    this.press = (event) => this.key_(event);
    this.leave = (event) => { if (this.clerk.unsaved) event.preventDefault(); };
  }

  async begin(at) {
    const opening = this.source.open();
    await this.source.timed;
    if (this.source.times.length) {  // the first image is requested before everything else
      const row = this.source.rowAt(at);
      this.source.want(row, WHOLE);
      this.source.load(this.source.chunkOf(row));
    }
    const about = await opening;
    this.about = about;
    this.actions = about.actions;
    this.build();
    this.stage = new Stage(this.canvas, this.source);
    this.player = new Player(this.source, this.stage);
    this.stage.onPlace = (row, joint, to) => this.placeJoint(row, joint, to);
    this.stage.onDrag = (dragged) => this.tryJoint(dragged);
    this.stage.onPick = (pixel) => this.clerk.addPixel(pixel);
    this.player.shown = (row) => this.show(row);
    this.player.stopped = () => this.follow();
    this.strips.forEach((strip) => {
      strip.duration = about.duration_s;
      strip.colours = new Map(about.actions.map((one) => [one.word, one.colour]));
      strip.go = (time) => this.stop(time);
      strip.mark = (from, to) => this.markSpan(from, to);
    });
    document.addEventListener("keydown", this.press);
    window.addEventListener("beforeunload", this.leave);
    this.player.go(this.source.rowAt(at));
    this.readBouts().then(() => this.doubts.read()).then(() => this.clerk.ask())
      .then(() => this.crossings.read())
      .catch((error) => this.notify(error.message, true));
    await this.stage.first;
  }

  build() {
    this.canvas = make("canvas", { class: "desk-stage", tabindex: "0", role: "img",
      "aria-label": "depth image as height above the floor, with the skeleton; keys are listed beside it" });
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
      this.viewButton = button("Whole image", "Z", () => this.view()), this.clock);
    this.now = make("p", { class: "desk-now" });
    this.message = make("p", { class: "desk-message", role: "status" });
    this.names = make("div", { class: "desk-actions", role: "group", "aria-label": "name the bout, or the marked span" },
      ...this.actions.map((one, k) => {
        const swatch = make("i", {});
        swatch.style.background = one.colour;
        const made = button("", keyOf(k) ? `key ${keyOf(k)}` : "", () => this.name(one.word), { "data-word": one.word });
        made.append(make("kbd", {}, keyOf(k) || " "), swatch, one.title);
        return made;
      }));
    const deeds = make("div", { class: "desk-bar" },
      button("No name", "0", () => this.unname()),
      button("Head ⇄ tail", "F", () => this.flip()),
      button("[ from", "[", () => this.mark(0)), button("to ]", "]", () => this.mark(1)),
      button("Take back", "U", () => this.clerk.undo()),
      button("Redo", "R", () => this.clerk.redo()));
    const side = make("div", { class: "desk-side" }, this.now,
      make("h3", {}, "What it does"), this.names, deeds, this.message, this.clerk.status,
      ...this.doubts.parts, ...this.crossings.parts,
      make("details", { class: "desk-keys" }, make("summary", {}, "Keys and mouse"),
        make("p", { class: "muted" }, "Drag a joint to put it elsewhere; drag the image to move it. Drag over the upper band to mark a span."),
        make("dl", {}, ...KEYS.flatMap(([name, does]) => [make("dt", {}, make("kbd", {}, name)), make("dd", {}, does)]))));
    this.place.replaceChildren(make("div", { class: "desk-left" }, this.canvas, bar, ...bands), side);
    this.place.addEventListener("click", (event) => {  // after a click the page gets the keys again
      if (event.detail && event.target.closest("button, summary")) this.canvas.focus({ preventScroll: true });
    });
  }

  time() { return this.source.times[this.player.row]; }

  stop(time) {  // and show the frame at this time
    this.player.play(false);
    this.player.go(this.source.rowAt(time));
  }

  show(row) {
    const time = this.source.times[row];
    this.strips.forEach((strip) => { strip.now = time; strip.paint(); });
    this.playButton.textContent = this.player.playing ? "❚❚ Pause" : "▶ Play";
    if (Number(this.speed.value) !== this.player.speed) this.speed.value = String(this.player.speed);
    this.clock.textContent = `${time.toFixed(3)} s of ${this.about.duration_s.toFixed(1)} s`;
    const data = this.source.at(row), bout = this.boutAt(time);
    const facts = [bout ? bout.action.replaceAll("_", " ") : "unlabelled"];
    if (data && data.flag) facts.push(data.flag.replaceAll("_", " "));
    if (data && data.error !== null) facts.push(`error ${data.error.toFixed(1)} mm`);
    if (data) facts.push(`frame ${data.frame}`);
    this.now.textContent = facts.join(" · ");
    [...this.names.children].forEach((one) => one.classList.toggle("is-now", Boolean(bout) && bout.action === one.dataset.word));
    if (!this.player.playing) this.follow();
  }

  follow() {  // the page's other figures follow, once the moment is steady
    clearTimeout(this.following);
    this.following = setTimeout(() => {
      if (this.player.playing || this.player.closed) return;
      this.heard = Number(this.time().toFixed(4));
      this.page.moment(this.heard);
    }, FOLLOW_MS);
  }

  moment(at) {  // another moment was selected elsewhere on the page
    if (!this.player) return;
    if (this.heard !== undefined && Math.abs(at - this.heard) < 1e-6) return;
    clearTimeout(this.following);
    this.player.play(false);
    clearTimeout(this.following);
    this.player.go(this.source.rowAt(at));
  }

  boutAt(time) { return this.bouts.find((one) => one.start_s <= time + 5e-4 && time + 5e-4 < one.stop_s); }

  async readBouts() {
    this.bouts = await json(`${this.source.base}/bouts`);
    this.strips.forEach((strip) => { strip.bouts = this.bouts; });
    const known = new Set(this.actions.map((one) => one.word));
    if (this.bouts.some((one) => !known.has(one.action))) {  // a new word was used
      const about = await json(`${this.source.base}/about`);
      this.strips.forEach((strip) => { strip.colours = new Map(about.actions.map((one) => [one.word, one.colour])); });
    }
    this.show(this.player.row);
  }

  view() {
    if (this.stage.follow) this.stage.whole(); else this.stage.fit();
    this.viewButton.textContent = this.stage.follow ? "Whole image" : "Go with the animal";
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
    if (from !== null && to !== null) this.notify(`marked ${from.toFixed(2)} to ${to.toFixed(2)} s`);
    else if (from !== null || to !== null) this.notify(`marked ${from !== null ? `from ${from.toFixed(2)}` : `to ${to.toFixed(2)}`} s`);
  }

  async name(word) {
    const [from, to] = this.span, time = this.time();
    if (from !== null && to !== null) return this.clerk.correct(`add ${quoted(word)} ${from.toFixed(4)} ${to.toFixed(4)}`);
    if (this.boutAt(time)) return this.clerk.correct(`rename ${time} ${quoted(word)}`);
    this.notify(`nothing is named at ${time.toFixed(2)} s; mark the span with [ and ], then press the number`, true);
    return null;
  }

  number(k) {
    const action = this.actions[k];
    if (action) return this.name(action.word);
    this.notify("no action has this key");
    return null;
  }

  unname() { return this.clerk.correct(`delete ${this.time()}`); }

  flip() {
    const [from, to] = this.span;
    return this.clerk.correct(from !== null && to !== null ? `flip ${from.toFixed(4)} ${to.toFixed(4)}` : "flip");
  }

  moved(row, joint, to) {  // in words
    const data = this.source.at(row);
    return `joint ${quoted(this.about.joints[joint])} ${data.frame} ${to[0].toFixed(3)} ${to[1].toFixed(3)}`;
  }

  placeJoint(row, joint, to) {
    const known = `${row}/${joint}`;
    this.stage.placed.set(known, to);
    return this.clerk.correct(this.moved(row, joint, to), known);
  }

  async tryJoint(dragged) {  // the joint's position, including its height: one request at a time
    dragged.asked = dragged.to;
    if (this.trying) return;
    this.trying = true;
    while (dragged.asked && this.stage.dragged === dragged) {
      const sentence = this.moved(dragged.row, dragged.joint, dragged.asked);
      dragged.asked = null;
      try {
        const answer = await this.clerk.post({ sentence, try: true });
        dragged.label = `z ${answer.z_mm.toFixed(1)} mm${answer.note ? ", height kept" : ""}`;
        if (this.stage.dragged === dragged) this.notify(answer.message);
      } catch (error) {
        dragged.label = "not here";
        if (this.stage.dragged === dragged) this.notify(error.message, true);
      }
      this.stage.changed();
    }
    this.trying = false;
  }

  async refresh() {
    this.crossings.forget();
    await Promise.all([this.source.forgetRows(), this.readBouts()]);
    this.player.wake();
    this.doubts.read().then(() => this.crossings.read()).catch((error) => this.notify(error.message, true));
  }

  notify(text, wrong = false) {
    this.message.textContent = text;
    this.message.classList.toggle("is-wrong", wrong);
  }

  key_(event) {
    if (typing(event)) return;
    const act = actOf(this, event);
    if (!act || (event.repeat && !["ArrowLeft", "ArrowRight"].includes(event.key))) return;
    event.preventDefault();
    act();
    this.player.wake();
  }
}

function quoted(word) { return `'${word.replaceAll("'", `'"'"'`)}'`; }  // one word of a sentence, with shell quoting
