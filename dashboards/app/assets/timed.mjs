// Figures over time: a click selects a moment, a drag enlarges a stretch; a double-click shows all.

const DRAGGED_PX = 6;

export function timeAt(event, box, axis) {  // s; the axis ends at shares of the box's width
  const x = (event.clientX - box.left) / box.width;
  const share = (x - axis.left) / (axis.right - axis.left);
  return axis.from_s + Math.min(Math.max(share, 0), 1) * (axis.to_s - axis.from_s);
}

export function timed(place, axisOf, { click, zoom }) {
  let from = null, shade = null;
  const drop = () => { if (shade) shade.remove(); shade = null; };
  const at = (event) => timeAt(event, boxOf(event, place), axisOf());
  const boxOf = (event) => (place.querySelector("svg") || place).getBoundingClientRect();
  place.addEventListener("pointerdown", (event) => {
    if (event.button || event.target.closest("a") || !axisOf()) return;
    from = { x: event.clientX, at: at(event), target: event.target };
  });
  place.addEventListener("pointermove", (event) => {
    if (!from || Math.abs(event.clientX - from.x) < DRAGGED_PX) return;
    if (!shade) {
      shade = document.createElement("div");
      shade.className = "shade";
      place.append(shade);
    }
    const left = place.getBoundingClientRect().left;
    shade.style.left = `${Math.min(event.clientX, from.x) - left}px`;
    shade.style.width = `${Math.abs(event.clientX - from.x)}px`;
    event.preventDefault();
  });
  document.addEventListener("pointerup", (event) => {
    if (!from) return;
    const began = from, stretch = [began.at, at(event)].sort((a, b) => a - b);
    from = null;
    if (shade && zoom) zoom(...stretch);
    else if (!shade) click(began.at, began.target);
    drop();
  });
  if (zoom) place.addEventListener("dblclick", () => zoom(null, null));
}
