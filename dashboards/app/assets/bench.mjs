// The progress of the job on the page "Measure", once a second. All texts are set as text.

import { json } from "./desk_source.mjs";

const job = document.getElementById("job");
const at = (name) => document.getElementById(`job-${name}`);

function show(state) {
  job.hidden = !state.verb;
  if (!state.verb) return;
  const done = state.code === 0 ? "done" : state.code === 4 ? "done, needs review" : `ended with code ${state.code}`;
  at("title").textContent = `${state.verb === "run" ? "Measure" : "Examine"} ${state.at}: ${state.running ? "running" : done}`;
  at("stages").textContent = state.stages.join("\n");
  at("stages").hidden = !state.stages.length;
  at("lines").textContent = state.lines.join("\n");
  at("lines").hidden = !state.lines.length;
  at("stop").hidden = !state.running;
  at("done").hidden = state.running || state.verb !== "run";
}

async function follow() {
  const state = await json("/bench/state");
  show(state);
  if (state.running) setTimeout(follow, 1000);
}

if (!job.hidden) follow().catch((error) => { at("lines").textContent = error.message; });
