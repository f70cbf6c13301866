// Doubtful stretches: a list to review one by one; this browser remembers the reviewed ones.

import { button, kept, make } from "./desk_parts.mjs";
import { json } from "./desk_source.mjs";

export class Doubts {
  constructor(desk) {
    this.desk = desk;
    this.all = [];
    this.at = -1;
    this.keep = `liex-looked-${desk.key}`;
    this.reviewed = new Set(JSON.parse(kept(this.keep) || "[]"));
    this.list = make("ol", { class: "desk-doubts" });
    this.count = make("span", { class: "muted" });
    this.parts = [make("h3", {}, "Doubtful frames ", this.count),
      make("div", { class: "desk-bar" }, button("◀", "P", () => this.next(-1), { "aria-label": "previous doubtful frame" }),
        button("Next doubtful", "N", () => this.next(1), { class: "main" }),
        button("Correct as is", "K", () => this.right())),
      this.list];
  }

  get here() { return this.all[this.at]; }

  async read() {  // poses at once; actions need a model
    const { base } = this.desk.source;
    const poses = await json(`${base}/doubts`);
    this.take(poses);
    json(`${base}/doubts?of=actions`).then((actions) => {
      if (!this.desk.player.closed) this.take([...poses, ...actions].sort((a, b) => a.start_s - b.start_s));
    }, () => {});
  }

  take(found) {
    const now = this.here;
    this.all = found.map((one) => ({ ...one, done: this.reviewed.has(nameOf(one)) }));
    this.at = now ? this.all.findIndex((one) => nameOf(one) === nameOf(now)) : -1;
    this.desk.strips.forEach((strip) => { strip.doubts = this.all; });
    this.list.replaceChildren(...this.all.map((one, k) => {
      const line = button("", "go to this place", () => this.go(k), { class: "link" });
      line.append(make("b", {}, `${one.start_s.toFixed(2)} s `), one.why);
      return make("li", {}, line);
    }));
    this.update();
  }

  update() {
    const left = this.all.filter((one) => !one.done).length;
    this.count.textContent = this.all.length ? `${left} of ${this.all.length} left` : "none";
    [...this.list.children].forEach((line, k) => {
      line.classList.toggle("is-done", this.all[k].done);
      line.classList.toggle("is-now", k === this.at);
    });
    this.desk.strips.forEach((strip) => strip.paint());
    const line = this.list.children[this.at];
    if (line) this.list.scrollTop = Math.max(0, line.offsetTop - this.list.offsetTop - 40);
  }

  go(k) {
    this.at = k;
    const one = this.here;
    this.desk.stop((one.start_s + one.stop_s) / 2);
    this.desk.notify(`${one.start_s.toFixed(2)} to ${one.stop_s.toFixed(2)} s: ${one.why}`);
    this.update();
  }

  next(way) {
    const n = this.all.length, time = this.desk.time();
    if (!n) { this.desk.notify("no place is in doubt"); return; }
    const from = this.at >= 0 ? this.at : way > 0 ? this.all.findIndex((one) => one.start_s >= time) - 1
      : this.all.filter((one) => one.stop_s <= time).length;
    for (let k = 1; k <= n; k += 1) {
      const next = (((from + way * k) % n) + n) % n;
      if (!this.all[next].done) { this.go(next); return; }
    }
    this.desk.notify("all places in doubt have been reviewed");
  }

  right() {
    if (!this.here) { this.desk.notify("go to a doubtful frame first, with N"); return; }
    this.done(this.here);
    this.next(1);
  }

  corrected(one, time) {  // a correction at this time completes the review of the current stretch
    if (one && one.start_s - 0.5 <= time && time <= one.stop_s + 0.5) this.done(one);
  }

  done(one) {
    one.done = true;
    this.reviewed.add(nameOf(one));
    kept(this.keep, JSON.stringify([...this.reviewed]));
    this.update();
  }
}

function nameOf(doubt) { return `${doubt.kind}/${doubt.start_s.toFixed(3)}`; }
