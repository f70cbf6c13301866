// What the page of a session shows first is asked for while the page around is still being built.

import { Source } from "./desk_source.mjs";

const WHOLE = [0, 0, 1 << 16, 1 << 16];  // is cut to the picture
let coming = null;

export function sourceOf(key) {  // of a session; the one that is on its way already, once
  const known = coming && coming.key === key ? coming.source : null;
  coming = null;
  return known || new Source(`/desk/${encodeURIComponent(key)}`);
}

async function ahead(path, asked) {
  const key = decodeURIComponent(path.slice("/session/".length));
  const source = new Source(`/desk/${encodeURIComponent(key)}`);
  coming = { key, source };
  const opened = source.open();
  await source.timed;
  if (!source.times.length) return opened;  // it was not measured, and the page says why
  const row = source.rowAt(Number(new URLSearchParams(asked).get("t")) || 0);
  source.want(row, WHOLE);  // how much of it will be seen is not known yet
  source.load(source.chunkOf(row));
  await opened;
}

if (window.location.pathname.startsWith("/session/")) {
  ahead(window.location.pathname, window.location.search).catch(() => { coming = null; });  // the page says why
  import("./desk.mjs");
}
