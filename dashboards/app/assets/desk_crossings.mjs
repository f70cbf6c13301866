// Crossings: stretches in which head and tail, or two animals, were or may have been exchanged.

import { button, make } from "./desk_parts.mjs";
import { json } from "./desk_source.mjs";

const NEAR_S = 1e-3;  // tolerance of being at a crossing's beginning

export class Crossings {
  constructor(desk) {
    this.desk = desk;
    this.all = null;  // until they are loaded
    this.asked = 0;  // the direction requested before they were loaded
    this.turn = 0;  // number of reloads
    this.at = -1;  // the last one that was shown
    this.count = make("span", { class: "muted desk-crossings" });
    this.parts = [make("div", { class: "desk-bar" },
      button("◀", "Shift and X", () => this.next(-1), { "aria-label": "previous crossing" }),
      button("Next crossing", "X", () => this.next(1)), this.count)];
  }

  forget() {  // a correction may change the list
    this.all = null;
    this.at = -1;
    this.turn += 1;
  }

  async read() {
    const turn = this.turn, all = await json(`${this.desk.source.base}/crossings`);
    if (turn !== this.turn) return;  // corrected in the meantime, and reloaded
    this.all = all;
    this.count.textContent = this.all.length ? `${this.all.length} in all` : "none";
    const asked = this.asked;
    this.asked = 0;
    if (asked) this.next(asked);
  }

  next(way) {
    if (!this.all) { this.asked = way; this.desk.notify("crossings are still being searched for"); return; }
    const n = this.all.length, time = this.desk.time();
    if (!n) {
      this.desk.notify("there is no crossing: nowhere were head and tail, or the animal and another object, found to be exchanged or perhaps so");
      return;
    }
    if (this.all[0].kind === "swap") {  // the likeliest first, not in order of time
      const last = this.all[this.at], there = last && Math.abs(last.start_s - time) <= NEAR_S;
      this.go(there ? (this.at + way + n) % n : 0, "");
      return;
    }
    const found = way > 0 ? this.all.findIndex((one) => one.start_s > time + NEAR_S)
      : this.all.filter((one) => one.start_s < time - NEAR_S).length - 1;
    const k = found >= 0 ? found : way > 0 ? 0 : n - 1;
    this.go(k, found >= 0 ? "" : way > 0 ? "from the beginning again: " : "from the end again: ");
  }

  go(k, first) {
    const one = this.all[k], several = this.desk.about.animals.length > 1;
    this.at = k;
    this.desk.stop(one.start_s);
    this.desk.notify(`${first}crossing ${k + 1} of ${this.all.length}, ${one.start_s.toFixed(2)} to ${one.stop_s.toFixed(2)} s`
      + `${several ? `, ${one.individual}` : ""}: ${one.why}`);
  }
}
