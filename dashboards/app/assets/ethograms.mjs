// Ethograms of several sessions: a click opens the session at that moment, a drag enlarges a stretch.

import { timed } from "./timed.mjs";

const place = document.getElementById("ethograms");

function show(from, to) {
  const address = new URL(window.location);
  ["from", "to"].forEach((name) => address.searchParams.delete(name));
  if (from !== null) { address.searchParams.set("from", from.toFixed(3)); address.searchParams.set("to", to.toFixed(3)); }
  if (address.href !== window.location.href) window.location = address;
}

if (place) {
  const axis = { left: 0, right: 1, from_s: Number(place.dataset.from), to_s: Number(place.dataset.to) };
  let opening = null;
  timed(place, () => axis, {
    zoom: show,
    click: (at, target) => {
      const row = target.closest(".row");
      clearTimeout(opening);  // a double-click shows all
      if (row) opening = setTimeout(() => { window.location = `/session/${encodeURIComponent(row.dataset.key)}?t=${at.toFixed(3)}`; }, 250);
    },
  });
  place.addEventListener("dblclick", () => clearTimeout(opening));
}

const budgets = document.getElementById("budgets");
if (budgets) {
  budgets.addEventListener("click", (event) => {
    const row = event.target.closest(".row");
    if (row) window.location = `/session/${encodeURIComponent(row.dataset.key)}`;
  });
}
