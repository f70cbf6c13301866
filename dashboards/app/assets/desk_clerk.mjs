// Queued corrections: accepted, saved, undone; unsaved ones, and errors.

import { json } from "./desk_source.mjs";
import { button, make } from "./desk_parts.mjs";

const ASK_MS = 250;  // polling interval until all is saved
const REPORT_MS = 1500;

export class Clerk {
  constructor(desk) {
    this.desk = desk;
    this.tickets = [];
    this.mine = [];  // corrections of this visit, which U undoes
    this.unsaved = 0;
    this.status = make("p", { class: "muted desk-saved", role: "status" });
    this.list = document.getElementById("correct-made");
    this.sentence = document.getElementById("correct-sentence");
    this.sentence.form.addEventListener("submit", async (event) => {
      event.preventDefault();
      if (await this.correct(this.sentence.value)) this.sentence.value = "";
    });
  }

  addPixel(pixel) {  // to the sentence in the text field
    if (!this.sentence.value.trim()) return;
    this.sentence.value = `${this.sentence.value.trim()} ${pixel.map((one) => one.toFixed(2)).join(" ")}`;
  }

  async correct(sentence, placed) {  // true once it is accepted
    const { desk } = this;
    const { here } = desk.doubts;
    let taken = false;
    try {
      const answer = await this.post({ sentence });
      taken = true;
      this.tickets.push({ ticket: answer.ticket, placed });
      this.mine.push({ ticket: answer.ticket });
      desk.notify(answer.message);
      desk.markSpan(null, null);
      desk.doubts.corrected(here, desk.time());
    } catch (error) {
      if (placed) desk.stage.placed.delete(placed);
      desk.notify(error.message, true);
      desk.player.wake();
    }
    this.soon();
    return taken;
  }

  async undo() {
    const { desk } = this, last = this.mine.pop();
    if (last === undefined) {
      desk.notify("nothing of this visit is left to take back; the list of corrections below has those of before");
      return;
    }
    await this.change("taking back …", { undo: true, ...last });
  }

  async redo() {  // the correction that was last undone, in this visit or before
    const answer = await this.change("making again …", { redo: true });
    if (answer) this.mine.push({ number: answer.number });
  }

  async change(doing, asked) {
    const { desk } = this;
    let answer = null;
    desk.notify(doing);
    try {
      answer = await this.post(asked);
      this.tickets.push({ ticket: answer.ticket });
      desk.notify(answer.message);
    } catch (error) {
      desk.notify(error.message, true);
    }
    this.soon();
    return answer;
  }

  post(asked) {
    const by = document.getElementById("correct-by"), at_s = this.desk.player ? this.desk.time() : 0;
    return json(`${this.desk.source.base}/correct`,
      { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ ...asked, at_s, by: by ? by.value : "" }) });
  }

  soon() {
    this.unsaved = Math.max(this.unsaved, 1);
    this.status.textContent = "saving …";
    clearTimeout(this.asking);
    this.asking = setTimeout(() => this.ask().catch((error) => this.desk.notify(error.message, true)), ASK_MS);
  }

  async ask() {  // state of the corrections
    const { desk } = this, state = await json(`${desk.source.base}/state`);
    const done = this.tickets.filter((one) => ["saved", "failed"].includes((state.tickets[one.ticket] || { state: "failed" }).state));
    this.tickets = this.tickets.filter((one) => !done.includes(one));
    this.unsaved = state.unsaved;
    const n = state.log.length;
    this.show(state);
    this.reported ||= state.report_old;
    const report = state.report_old ? "; writing the report …" : this.reported ? "; the report is up to date" : "";
    this.status.textContent = state.unsaved ? `saving ${state.unsaved} …`
      : `${n === 1 ? "1 correction stands" : `${n} corrections stand`}, all saved${report}`;
    const failed = done.map((one) => state.tickets[one.ticket]).find((one) => one && one.state === "failed" && !one.message.startsWith("taken back"));
    if (failed) desk.notify(failed.message, true);
    if (done.length) {
      await desk.refresh();
      done.forEach((one) => one.placed && desk.stage.placed.delete(one.placed));
      desk.player.wake();
      desk.page.corrected();
      if (state.notes.length && !failed) desk.notify(state.notes[state.notes.length - 1], true);
    }
    if (this.tickets.length || state.unsaved) this.soon();
    else if (state.report_old) this.asking = setTimeout(() => this.ask().catch(() => {}), REPORT_MS);
  }

  show({ log, redo }) {  // the corrections in effect, each with a button that undoes it
    const back = (number) => button("Take back", "", () => this.change("taking back …", { undo: true, number }));
    const lines = log.map((one) => make("li", {}, `${one.number}: ${one.message} (${one.author}, ${one.made_at}) `, back(one.number)));
    this.list.replaceChildren(log.length ? make("ul", { class: "made" }, ...lines) : make("p", { class: "muted" }, "No corrections so far."),
      ...(redo ? [button(`Redo: ${redo}`, "", () => this.redo())] : []));
  }
}
