// The page of a session: desk, moment, curves, numbers, tables and replay are synchronised. All texts are set as text.

import { start } from "./desk.mjs";
import { make } from "./desk_parts.mjs";
import { json } from "./desk_source.mjs";
import { refreshAll } from "./tables.mjs";
import { timed } from "./timed.mjs";

const part = (id) => document.getElementById(id);
const { key } = part("desk").dataset, path = encodeURIComponent(key), field = part("moment");
const axes = { whole: null, around: null };
let at = Number(field.value) || 0, stretch = "", asked = false, busy = false, ready = false;

function show(time) {  // everything except the desk
  at = time;
  field.value = String(time);
  part("moment-link").firstElementChild.href = `/session/${path}?t=${time.toFixed(3)}`;
  cursor("whole");
  follow();
}

function go(time) { desk.moment(time); show(time); }

function cursor(id) {
  const axis = axes[id], place = part(id);
  let line = place.querySelector(".cursor");
  if (!axis) return;
  if (!line) place.append(line = make("div", { class: "cursor" }));
  const share = (at - axis.from_s) / (axis.to_s - axis.from_s);
  line.hidden = share < 0 || share > 1;
  line.style.left = `${100 * (axis.left + share * (axis.right - axis.left))}%`;
  line.dataset.at = String(at);
}

function draw(id, found) {
  axes[id] = found;
  part(id).innerHTML = found.svg;  // drawn and escaped by this server
  cursor(id);
}

function refused(error) {
  part("whole").replaceChildren(make("p", { class: "problems", role: "alert" }, error.message));
}

async function follow() {  // curves and numbers of the moment; of several requests only the last
  asked = true;
  if (busy || !ready) return;
  busy = true;
  try {
    while (asked) {
      asked = false;
      const found = await json(`/moment/${path}?t=${at}`);
      if (asked) continue;
      draw("around", found);
      part("replay-command").textContent = found.command;
      part("frame-facts").replaceChildren(...found.facts.flatMap(([what, much]) => [make("dt", {}, what), make("dd", {}, much)]));
    }
  } catch (error) { refused(error); }
  busy = false;
}

async function whole() {
  try { draw("whole", await json(`/whole/${path}${stretch}`)); } catch (error) { refused(error); }
}

function zoom(from, to) {
  stretch = from === null ? "" : `?from=${from}&to=${to}`;
  whole();
}

const desk = await start(key, at, { moment: show, corrected: () => { whole(); follow(); refreshAll(); } });
ready = true;  // figures keep a browser busy: they are loaded after the first image
whole().then(follow);
timed(part("whole"), () => axes.whole, { click: (time) => go(Number(time.toFixed(4))), zoom });
timed(part("around"), () => axes.around, { click: (time) => go(Number(time.toFixed(4))) });
field.addEventListener("change", () => go(Number(field.value) || 0));
document.addEventListener("click", async (event) => {
  const step = event.target.closest("[data-by]"), moment = event.target.closest("[data-moment]");
  if (moment) go(Number(moment.dataset.moment));
  if (step) go(await json(`/step/${path}?t=${at}&by=${step.dataset.by}&to=${step.dataset.to}`));
});
part("copy-command").addEventListener("click", () => navigator.clipboard && navigator.clipboard.writeText(part("replay-command").textContent));
const button = part("open-replay");
if (button) {
  button.addEventListener("click", async () => {
    const message = part("replay-message");
    try {
      message.textContent = (await json(`/replay/${path}`, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ at_s: at }) })).message;
    } catch (error) { message.textContent = error.message; }
  });
}
