// Blinded review: one clip at a time, repeated until it is named. All texts are set as text.

import { typing } from "./desk_keys.mjs";
import { button, make } from "./desk_parts.mjs";
import { Player } from "./desk_player.mjs";
import { Source, json } from "./desk_source.mjs";
import { Stage } from "./desk_stage.mjs";

const LIT_S = 0.12;  // time around the moment to be named in which the image has a border
class Review {
  constructor(place) {
    this.place = place;
    this.press = (event) => this.key(event);
    document.addEventListener("keydown", this.press);
  }

  async ask() {
    let names = [];
    try { names = await json("/reviews"); } catch (error) { this.wrong = error.message; }
    const field = (title, attributes) => {
      const input = make("input", attributes);
      return [input, make("label", {}, make("span", {}, title), input)];
    };
    const [rater, raterField] = field("Your name", { type: "text", required: true, maxlength: "60", id: "review-rater" });
    const [name, nameField] = field("Review", { type: "text", required: true, maxlength: "60", value: names[0] || "review", list: "review-names", id: "review-name" });
    const [n, nField] = field("Clips", { type: "number", min: "1", max: "500", value: "20", id: "review-n" });
    const [seed, seedField] = field("Seed", { type: "number", min: "0", value: "0", id: "review-seed" });
    this.message = make("p", { class: "desk-message is-wrong", role: "alert" }, this.wrong || "");
    const form = make("form", { class: "tools", onsubmit: async (event) => {
      event.preventDefault();
      try {
        const asked = { name: name.value, rater: rater.value, n: Number(n.value), seed: Number(seed.value) };
        const begun = await this.post("/reviews", asked);
        this.name = begun.name;
        this.rater = rater.value.trim();
        await this.go();
      } catch (error) { this.message.textContent = error.message; }
    } }, raterField, nameField, make("datalist", { id: "review-names" }, ...names.map((one) => make("option", { value: one }))),
      nField, seedField, make("button", { type: "submit", class: "main" }, "Begin, or go on"));
    this.place.replaceChildren(form, make("p", { class: "muted" },
      names.length ? `Clips and seed are those of a new review; existing ones: ${names.join(", ")}.` : "There is no review of this study yet."), this.message);
  }

  get base() { return `/reviews/${encodeURIComponent(this.name)}`; }

  post(address, asked) {
    return json(address, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(asked) });
  }

  async go() {
    this.state = await json(`${this.base}/state?rater=${encodeURIComponent(this.rater)}`);
    this.at = this.state.order.findIndex((clip) => !(clip in this.state.answers));
    if (this.at < 0) { this.end(); return; }
    this.build();
    await this.show();
  }

  build() {
    this.canvas = make("canvas", { class: "desk-stage", tabindex: "0", role: "img", "aria-label": "clip of an animal, height above the floor" });
    this.count = make("p", { class: "desk-now", role: "status" });
    this.message = make("p", { class: "desk-message", role: "status" });
    const words = [...this.state.words.entries()].map(([k, one]) => {
      const swatch = make("i", {});
      swatch.style.background = one.colour;
      const made = button("", "", () => this.answer(one.word));
      made.append(make("kbd", {}, k < 9 ? String(k + 1) : `⇧${k - 8}`), swatch, one.title);
      return made;
    });
    const none = button("", "", () => this.answer(""));
    none.append(make("kbd", {}, "0"), "none of these");
    const side = make("div", { class: "desk-side" }, this.count,
      make("p", { class: "muted" }, "Name what it does while the image has a yellow frame."),
      make("div", { class: "desk-actions", role: "group", "aria-label": "what it does" }, ...words, none),
      make("div", { class: "desk-bar" }, button("Play or pause", "space", () => this.player.play(!this.player.playing)),
        button("Slower", ",", () => this.player.faster(-1)), button("Faster", ".", () => this.player.faster(1)),
        button("Skeleton", "S", () => { this.stage.skeleton = !this.stage.skeleton; this.player.wake(); }),
        button("Clip before", "U", () => this.back())), this.message);
    this.place.replaceChildren(make("div", { class: "desk" }, make("div", { class: "desk-left" }, this.canvas), side));
    this.place.addEventListener("click", (event) => { if (event.detail && event.target.closest("button")) this.canvas.focus({ preventScroll: true }); });
  }

  async show() {
    const clip = this.state.order[this.at];
    if (this.player) this.player.closed = true;
    const canvas = make("canvas", { class: "desk-stage", tabindex: "0", role: "img", "aria-label": this.canvas.getAttribute("aria-label") });
    this.canvas.replaceWith(canvas);
    this.canvas = canvas;
    const source = new Source(`${this.base}/clip/${clip}`);
    const about = await source.open();
    this.stage = new Stage(canvas, source);
    this.stage.onPlaceable = () => false;
    this.stage.skeleton = false;
    const speed = this.player ? this.player.speed : 1;
    this.player = new Player(source, this.stage);
    this.player.speed = speed;
    this.player.loop = [0, source.times.length - 1];
    this.player.shown = (row) => { this.stage.lit = Math.abs(source.times[row] - about.moment_s) <= LIT_S; };
    this.player.go(0);
    this.player.play(true);
    this.ready = true;
    this.count.textContent = `Clip ${this.at + 1} of ${this.state.order.length}`;
    canvas.focus({ preventScroll: true });
  }

  async answer(word) {
    if (!this.ready) return;
    this.ready = false;
    try {
      const asked = { rater: this.rater, clip: this.state.order[this.at], word };
      this.state = await this.post(`${this.base}/answer`, asked);
      this.message.textContent = "";
      if (this.state.done && this.at + 1 >= this.state.order.length) { this.end(); return; }
      this.at += 1;
      await this.show();
    } catch (error) {
      this.message.textContent = error.message;
      this.ready = true;
    }
  }

  async back() {
    if (!this.ready || this.at === 0) return;
    this.at -= 1;
    await this.show();
  }

  end() {
    if (this.player) this.player.closed = true;
    this.ready = false;
    const number = (value) => (value === null ? "–" : value.toFixed(2));
    const rows = this.state.agreements.map((one) => make("tr", {}, make("td", {}, one.first), make("td", {}, one.second),
      make("td", { class: "n" }, String(one.n)), make("td", { class: "n" }, one.observed === null ? "–" : `${Math.round(100 * one.observed)} %`),
      make("td", { class: "n kappa" }, number(one.kappa)), make("td", { class: "n" }, `${number(one.low)} to ${number(one.high)}`)));
    const heads = ["rater", "and", "clips", "same word", "kappa", "95 % interval"].map((title, k) =>
      make("th", { scope: "col", class: k > 1 ? "n" : "" }, button(title, "", () => {}, { disabled: true })));
    this.place.replaceChildren(make("h2", {}, `${this.rater} has named all ${this.state.order.length} clips`),
      make("div", { class: "scroll" }, make("table", {}, make("thead", {}, make("tr", {}, ...heads)), make("tbody", {}, ...rows))),
      make("p", { class: "muted" }, "Cohen's kappa: 1 where two always agree, 0 where no more than by chance. The clips were drawn so that rare actions occur, "
        + "each word of the program in turn, so this is not the agreement over all of the time. Raters with unnamed clips are left out."),
      button("Another rater", "", () => this.ask(), { class: "main" }));
  }

  key(event) {
    if (!this.player || !this.ready || typing(event)) return;
    const acts = {
      " ": () => this.player.play(!this.player.playing), ",": () => this.player.faster(-1), ".": () => this.player.faster(1),
      s: () => { this.stage.skeleton = !this.stage.skeleton; }, u: () => this.back(),
    };
    const digit = /^[0-9]$/.test(event.key) ? Number(event.key) : null, code = /^Digit([1-9])$/.exec(event.code);
    const k = digit !== null ? digit - 1 : code && event.shiftKey ? Number(code[1]) + 8 : null;
    let act = acts[event.key.toLowerCase()];
    if (k === -1) act = () => this.answer("");
    else if (k !== null && this.state.words[k]) act = () => this.answer(this.state.words[k].word);
    if (!act || event.repeat) return;
    event.preventDefault();
    act();
    this.player.wake();
  }
}

new Review(document.getElementById("review")).ask();
