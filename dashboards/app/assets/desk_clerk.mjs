// Corrections on their way: taken, saved, taken back; what is not saved yet, and what went wrong.

import { json } from "./desk_source.mjs";
import { make, set } from "./desk_parts.mjs";

const ASK_MS = 250;  // how often it is asked whether all is saved
const REPORT_MS = 1500;

export class Clerk {
  constructor(desk) {
    this.desk = desk;
    this.tickets = [];
    this.mine = [];  // what this visit did, to be taken back by U
    this.unsaved = 0;
    this.told = make("p", { class: "muted desk-saved", role: "status" });
  }

  close() { clearTimeout(this.asking); }

  async correct(asked, placed) {
    const { desk } = this;
    if (!desk.about.may_correct) return;
    const by = document.getElementById("correct-by");
    const { here } = desk.doubts;
    try {
      const told = await this.post({ ...asked, by: by ? by.value : "" });
      this.tickets.push({ ticket: told.ticket, placed });
      this.mine.push(told.ticket);
      desk.say(told.said);
      desk.markSpan(null, null);
      desk.doubts.corrected(here, desk.time());
    } catch (error) {
      if (placed) desk.stage.placed.delete(placed);
      desk.say(error.message, true);
      desk.player.wake();
    }
    this.soon();
  }

  async undo() {
    const { desk } = this, ticket = this.mine.pop();
    if (ticket === undefined) {
      desk.say("nothing of this visit is left to take back; the list of corrections below has those of before");
      return;
    }
    desk.say("taking back …");
    try {
      const told = await this.post({ what: "undo", ticket });
      if (told.ticket !== null) this.tickets.push({ ticket: told.ticket });
      desk.say(told.said);
    } catch (error) {
      desk.say(error.message, true);
    }
    this.soon();
  }

  post(asked) {
    return json(`${this.desk.source.base}/correct`,
      { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(asked) });
  }

  soon() {
    this.unsaved = Math.max(this.unsaved, 1);
    this.told.textContent = "saving …";
    clearTimeout(this.asking);
    this.asking = setTimeout(() => this.ask().catch((error) => this.desk.say(error.message, true)), ASK_MS);
  }

  async ask() {  // how far the corrections are
    const { desk } = this, state = await json(`${desk.source.base}/state`);
    if (desk.player.closed) return;
    const done = this.tickets.filter((one) => ["saved", "failed"].includes((state.tickets[one.ticket] || { state: "failed" }).state));
    this.tickets = this.tickets.filter((one) => !done.includes(one));
    this.unsaved = state.unsaved;
    const n = state.log.length;
    this.told.textContent = state.unsaved ? `saving ${state.unsaved} …`
      : `${n === 1 ? "1 correction stands" : `${n} corrections stand`}, all saved${state.report_old ? "; the report follows" : ""}`;
    const failed = done.map((one) => state.tickets[one.ticket]).find((one) => one && one.state === "failed" && !one.said.startsWith("taken back"));
    if (failed) desk.say(failed.said, true);
    if (done.length) {
      await desk.refresh();
      done.forEach((one) => one.placed && desk.stage.placed.delete(one.placed));
      desk.player.wake();
      this.made = `${n}-${Date.now()}`;
      set("corrections-made", { data: this.made });
    }
    if (this.tickets.length || state.unsaved) this.soon();
    else if (state.report_old) this.asking = setTimeout(() => this.ask().catch(() => {}), REPORT_MS);
  }
}
