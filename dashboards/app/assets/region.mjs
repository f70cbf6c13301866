// A region is drawn over a depth image, by mouse, touch or keys, and saved to the plan. All texts are set as text.

import { json } from "./desk_source.mjs";
import { button, make } from "./desk_parts.mjs";

const GRAB_PX = 12;  // distance within which the pointer grabs a corner or a side
const CORNER_PX = 6;
const SVG = "http://www.w3.org/2000/svg";
const KEYS = [
  ["click", "a corner; on a side of a closed polygon a new one"], ["drag", "moves a corner"],
  ["first corner", "a click on it closes the polygon"],
  ["← → ↑ ↓", "move the cross, or the corner that is chosen; with Shift ten pixels"],
  ["Enter", "a corner at the cross"], ["C", "close the polygon"], ["N P", "choose the next, the previous corner; Esc none"],
  ["Del", "take the chosen corner out, else the last"], ["U", "undo"],
];
function shape(name, attributes) {
  const made = document.createElementNS(SVG, name);
  Object.entries(attributes).forEach(([at, value]) => made.setAttribute(at, value));
  return made;
}

class Region {
  constructor(place, key) {
    this.place = place;
    this.base = `/region/${encodeURIComponent(key)}`;
    this.shape = { corners: [], closed: false };
    this.past = [];
    this.chosen = null;
    this.held = null;
    this.cross = null;
    window.addEventListener("resize", () => this.paint());
  }

  async begin() {
    this.place.replaceChildren(make("p", { class: "muted" }, "Reading the image ..."));
    this.take(await json(`${this.base}/about`));
    this.build();
    this.show(this.about.region);
  }

  take(about) { this.about = about; }

  show(corners) {  // the region in the plan
    this.shape = { corners: (corners || []).map((one) => [...one]), closed: Boolean(corners && corners.length > 2) };
    this.paint();
  }

  build() {
    const { width, height } = this.about;
    this.stage = shape("svg", {
      viewBox: `-0.5 -0.5 ${width} ${height}`, class: "region-stage", tabindex: "0", role: "application",
      "aria-label": "depth image; arrow keys move a cross, Enter puts a corner, C closes the polygon",
    });
    this.image = shape("image", { x: -0.5, y: -0.5, width, height, preserveAspectRatio: "none" });
    this.scene = shape("g", {});
    this.layer = shape("g", {});
    this.stage.append(this.image, this.scene, this.layer);
    this.stage.addEventListener("pointerdown", (event) => this.down(event));
    this.stage.addEventListener("pointermove", (event) => this.move(event));
    this.stage.addEventListener("pointerup", (event) => this.up(event));
    this.stage.addEventListener("pointercancel", () => { this.held = null; });
    this.stage.addEventListener("keydown", (event) => this.key(event));
    this.at = make("span", { class: "region-at" });
    this.message = make("p", { class: "region-message", role: "status" });
    const bar = make("div", { class: "region-bar", role: "toolbar", "aria-label": "the polygon" },
      this.closer = button("Close", "close the polygon (C)", () => this.closeShape()),
      button("Undo", "undo (U)", () => this.undo()),
      button("Clear", "take every corner away", () => this.change({ corners: [], closed: false })),
      ...this.imageChoice(), this.at);
    this.side = make("div", {});
    this.place.replaceChildren(make("div", {}, this.stage, bar), this.side);
    this.place.className = "region is-open";
    this.showImage(this.about.measured ? "session" : "recording");
    this.about.marks.forEach((one) => this.mark(one));
    this.panel();
  }

  imageChoice() {
    if (!(this.about.measured && this.about.has_recording)) return [];
    const chooser = make("select", { "aria-label": "image", onchange: () => this.showImage(chooser.value) },
      make("option", { value: "session" }, "image of the session"),
      make("option", { value: "recording" }, "image of the whole recording"));
    return [chooser];
  }

  showImage(of) {
    const address = `${this.base}/image.png?of=${of}`;
    this.image.addEventListener("error", async () => {  // the reason, in words
      const answer = await fetch(address);
      if (!answer.ok) this.notify((await answer.json()).message, true);
    }, { once: true });
    this.image.setAttribute("href", address);
  }

  mark({ kind, points, label }) {
    const text = shape("title", {});
    text.textContent = `${kind} ${label}`.trim();
    if (points.length > 1) {
      const line = shape("polygon", { class: "scene-line", points: points.join(" ") });
      line.append(text);
      this.scene.append(line);
      return;
    }
    const [u, v] = points[0], r = this.about.width / 90;
    const cross = shape("path", { class: `scene-place is-${kind}`, d: `M${u - r} ${v}H${u + r}M${u} ${v - r}V${v + r}` });
    cross.append(text);
    this.scene.append(cross);
  }

  panel() {
    const places = this.about.places.map((one) => {
      const input = make("input", { type: "radio", name: "region-place", value: one.name, checked: one.name === this.about.place,
        onchange: () => { this.about.place = one.name; this.paint(); } });
      return make("label", {}, input, ` ${one.title} (${one.file}${one.stated === null ? "" : ", states one now"})`);
    });
    this.corners = make("textarea", { rows: "4", id: "region-corners", spellcheck: "false", onchange: () => this.typed() });
    this.lines = make("pre", { id: "region-lines" });
    this.command = make("pre", { id: "region-command" });
    this.saver = button("Save into the plan", "write it into the file", () => this.save(this.shape.corners), { class: "main" });
    this.remover = button("Take it out of the plan", "the arena is found again", () => this.save(null));
    this.zoneName = make("input", { type: "text", id: "zone-name", size: "14", pattern: "[A-Za-z][A-Za-z0-9_]*", placeholder: "name", "aria-label": "name of the zone" });
    this.zonePart = make("select", { id: "zone-part", "aria-label": "part of the animal that counts" },
      ...["centre", "nose", "tail_base"].map((one) => make("option", { value: one }, one.replace("_", " "))));
    this.zoneSaver = button("Save as a zone", "write it into the file of zones", () => this.saveZone(this.zoneName.value, this.zonePart.value, this.shape.corners));
    const zones = this.about.zones.map(({ name, part, corners }) => make("li", {}, `${name} (${part.replace("_", " ")}) `,
      button("show", "take its corners", () => { this.zoneName.value = name; this.zonePart.value = part; this.show(corners); }),
      button("take out", "remove the zone", () => this.saveZone(name, part, null))));
    const list = make("dl", {});
    KEYS.forEach(([key, does]) => list.append(make("dt", {}, make("kbd", {}, key)), make("dd", {}, does)));
    this.side.replaceChildren(
      make("label", { for: "region-corners" }, "Corners x,y in pixels"), this.corners,
      make("fieldset", {}, make("legend", {}, "It is the region of"), ...places),
        make("div", { class: "region-bar" }, this.saver, this.remover),
        make("fieldset", { id: "zones" }, make("legend", {}, "Or it is a zone"),
          make("div", { class: "region-bar" }, this.zoneName, this.zonePart, this.zoneSaver), make("ul", {}, ...zones)),
      this.message, make("h3", {}, "Lines for a plan"), this.lines, make("h3", {}, "Try it first"), this.command,
      make("details", { class: "desk-keys" }, make("summary", {}, "Mouse and keys"), list));
    if (this.about.message) this.notify(this.about.message, true);
  }

  pixel(event) {
    const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(this.stage.getScreenCTM().inverse());
    return this.inside([at.x, at.y]);
  }

  inside([u, v]) {
    const fit = (value, most) => Math.round(10 * Math.min(Math.max(value, 0), most - 1)) / 10;
    return [fit(u, this.about.width), fit(v, this.about.height)];
  }

  scale() { return 1 / this.stage.getScreenCTM().a; }  // image pixels per screen pixel

  near([u, v]) {  // the corner under the pointer
    let best = null, least = GRAB_PX * this.scale();
    this.shape.corners.forEach(([a, b], k) => {
      const away = Math.hypot(a - u, b - v);
      if (away < least) { least = away; best = k; }
    });
    return best;
  }

  side_([u, v]) {  // the side of the closed polygon under the pointer
    const { corners } = this.shape;
    let best = null, least = GRAB_PX * this.scale();
    corners.forEach(([a, b], k) => {
      const [c, d] = corners[(k + 1) % corners.length], long = (c - a) ** 2 + (d - b) ** 2;
      const share = long ? Math.min(1, Math.max(0, ((u - a) * (c - a) + (v - b) * (d - b)) / long)) : 0;
      const away = Math.hypot(a + share * (c - a) - u, b + share * (d - b) - v);
      if (away < least) { least = away; best = k; }
    });
    return best;
  }

  down(event) {
    if (event.button) return;
    event.preventDefault();
    this.stage.focus({ preventScroll: true });
    const at = this.pixel(event), near = this.near(at);
    this.cross = null;
    if (near !== null) {
      this.hold(near, event, false);
    } else if (!this.shape.closed) {
      this.put(at);
      this.hold(this.shape.corners.length - 1, event, true);
    } else {
      const side = this.side_(at);
      if (side !== null) {
        this.put(at, side + 1);
        this.hold(side + 1, event, true);
      } else this.chosen = null;
    }
    this.paint();
  }

  hold(k, event, isNew) {
    this.stage.setPointerCapture(event.pointerId);
    this.held = { k, isNew, before: JSON.stringify(this.shape), moved: false, began: [event.clientX, event.clientY] };
    this.chosen = k;
  }

  move(event) {
    const at = this.pixel(event);
    this.at.textContent = `${at[0].toFixed(0)}, ${at[1].toFixed(0)}`;
    if (!this.held) return;
    const away = Math.hypot(event.clientX - this.held.began[0], event.clientY - this.held.began[1]);
    if (!this.held.moved && away < 3) return;
    this.held.moved = true;
    this.shape.corners[this.held.k] = at;
    this.paint();
  }

  up() {
    const held = this.held;
    this.held = null;
    if (!held) return;
    if (held.moved && !held.isNew) this.past.push(held.before);
    else if (!held.moved && !held.isNew && held.k === 0 && !this.shape.closed) this.closeShape();
    if (this.shape.closed || !held.isNew) this.chosen = held.k; else this.chosen = null;
    this.paint();
  }

  put(at, where = this.shape.corners.length) {
    const corners = [...this.shape.corners];
    corners.splice(where, 0, at);
    this.change({ ...this.shape, corners });
  }

  change(next) {
    this.past.push(JSON.stringify(this.shape));
    this.nudged = null;
    this.shape = JSON.parse(JSON.stringify(next));
    if (this.chosen !== null && this.chosen >= this.shape.corners.length) this.chosen = null;
    this.paint();
  }

  closeShape() {
    if (this.shape.corners.length < 3) { this.notify("a polygon has three or more corners", true); return; }
    if (!this.shape.closed) this.change({ ...this.shape, closed: true });
  }

  undo() {
    const before = this.past.pop();
    if (before === undefined) { this.notify("nothing is left to undo"); return; }
    this.shape = JSON.parse(before);
    this.chosen = null;
    this.nudged = null;
    this.paint();
  }

  take_() {
    const k = this.chosen === null ? this.shape.corners.length - 1 : this.chosen;
    if (k < 0) return;
    const corners = this.shape.corners.filter((_, j) => j !== k);
    this.change({ corners, closed: this.shape.closed && corners.length > 2 });
  }

  step(du, dv) {
    if (this.chosen === null) {
      const [u, v] = this.cross || [(this.about.width - 1) / 2, (this.about.height - 1) / 2];
      this.cross = this.inside([Math.round(u) + du, Math.round(v) + dv]);
      this.at.textContent = this.cross.join(", ");
    } else {
      if (this.nudged !== this.chosen) this.past.push(JSON.stringify(this.shape));
      this.nudged = this.chosen;
      const [u, v] = this.shape.corners[this.chosen];
      this.shape.corners[this.chosen] = this.inside([u + du, v + dv]);
      this.at.textContent = this.shape.corners[this.chosen].join(", ");
    }
    this.paint();
  }

  choose(by) {
    const n = this.shape.corners.length;
    if (!n) return;
    this.chosen = this.chosen === null ? (by > 0 ? 0 : n - 1) : (this.chosen + by + n) % n;
    this.at.textContent = this.shape.corners[this.chosen].join(", ");
    this.paint();
  }

  key(event) {
    const undo = event.key.toLowerCase() === "z" && (event.ctrlKey || event.metaKey);
    if (!undo && (event.ctrlKey || event.metaKey || event.altKey)) return;
    const by = event.shiftKey ? 10 : 1;
    const acts = {
      ArrowLeft: () => this.step(-by, 0), ArrowRight: () => this.step(by, 0), ArrowUp: () => this.step(0, -by), ArrowDown: () => this.step(0, by),
      Enter: () => { if (this.cross && !this.shape.closed) this.put(this.cross); },
      " ": () => { if (this.cross && !this.shape.closed) this.put(this.cross); },
      c: () => this.closeShape(), n: () => this.choose(1), p: () => this.choose(-1), u: () => this.undo(),
      Escape: () => { this.chosen = null; this.nudged = null; this.paint(); },
      Delete: () => this.take_(), Backspace: () => this.take_(),
    };
    const act = undo ? () => this.undo() : acts[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!act) return;
    event.preventDefault();
    act();
  }

  typed() {
    const words = this.corners.value.trim().split(/[\s;]+/).filter((one) => one);
    const corners = words.map((one) => one.split(",").map((part) => (part ? Number(part) : NaN)));
    if (corners.some((one) => one.length !== 2 || !one.every(Number.isFinite))) {
      this.notify("corners are written as x,y with blanks between them, as in 60,40 260,40 260,200", true);
      return;
    }
    this.change({ corners, closed: corners.length > 2 });
  }

  paint() {
    if (!this.layer || !this.stage.getScreenCTM()) return;
    const { corners, closed } = this.shape, { width, height } = this.about, r = CORNER_PX * this.scale();
    const points = corners.map((one) => one.join(",")).join(" "), name = closed ? "polygon" : "polyline";
    const parts = [];
    if (closed) {
      const hole = `M${corners.map((one) => one.join(" ")).join("L")}Z`;
      parts.push(shape("path", { class: "outside", "fill-rule": "evenodd", d: `M-0.5 -0.5h${width}v${height}h${-width}Z${hole}` }));
    }
    if (corners.length > 1) parts.push(shape(name, { class: "under", points }), shape(name, { class: "sides", points }));
    corners.forEach(([u, v], k) => {
      const large = k === 0 && !closed ? 1.4 : 1;
      parts.push(shape("circle", { class: `corner${k === this.chosen ? " is-chosen" : ""}`, cx: u, cy: v, r: large * r }));
    });
    if (this.cross && this.chosen === null) {
      const [u, v] = this.cross;
      parts.push(shape("path", { class: "cross", d: `M${u - 2 * r} ${v}H${u + 2 * r}M${u} ${v - 2 * r}V${v + 2 * r}` }));
    }
    (this.about.zones || []).forEach((zone) => {
      const line = shape("polygon", { class: "zone-line", points: zone.corners.map((one) => one.join(",")).join(" ") });
      const text = shape("title", {});
      text.textContent = `zone ${zone.name}`;
      line.append(text);
      parts.unshift(line);
    });
    this.layer.replaceChildren(...parts);
    this.update();
  }

  update() {
    const { corners, closed } = this.shape, list = corners.map((one) => one.join(",")).join(" ");
    if (document.activeElement !== this.corners) this.corners.value = list;
    this.lines.textContent = closed ? `[arena]\nregion = [${corners.map((one) => `[${one.join(", ")}]`).join(", ")}]` : "the polygon is not closed";
    this.command.textContent = closed ? `liex doctor ${this.about.recording || "RECORDING"} --region '${list}'` : "";
    const place = this.about.places.find((one) => one.name === this.about.place);
    this.saver.disabled = !closed;
    this.zoneSaver.disabled = !closed;
    this.remover.disabled = !place || place.stated === null;
    this.closer.disabled = closed || corners.length < 3;
  }

  save(corners) {
    const place = this.about.places.find((one) => one.name === this.about.place);
    return this.send({ place: place.name, corners, was: place.stated }, place.name, corners === null);
  }

  saveZone(name, part, corners) {
    if (!/^[A-Za-z][A-Za-z0-9_]*$/.test(name)) { this.notify("a zone has a name of letters, digits and _", true); return null; }
    return this.send({ zone: { name, part }, corners }, this.about.place, true);
  }

  async send(asked, place, clear) {
    this.saver.disabled = true;
    try {
      const about = await json(`${this.base}/save`, {
        method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(asked),
      });
      this.take({ ...about, place });
      this.panel();
      if (clear) this.change({ corners: [], closed: false });
      this.paint();
      this.notify(about.saved);
    } catch (error) {
      this.notify(error.message, true);
      this.saver.disabled = !this.shape.closed;
    }
  }

  notify(text, wrong = false) {
    this.message.textContent = text;
    this.message.classList.toggle("is-wrong", wrong);
  }
}

const place = document.getElementById("region");
new Region(place, place.dataset.key).begin().catch((error) => {
  place.replaceChildren(make("p", { class: "problems", role: "alert" }, error.message));
});
