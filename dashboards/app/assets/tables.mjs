// Tables are HTML from this server; a heading sorts, a word filters. A form's selection applies at once.

const WAIT_MS = 250;

export async function refresh(block) {
  const { table, column = "", down = "" } = block.dataset, filter = block.querySelector(".filter");
  const asked = new URLSearchParams({ name: table, words: filter ? filter.value : "", column, down });
  const answer = await fetch(`/table?${asked}`);
  const place = block.querySelector(".scroll"), at = document.activeElement;
  const focused = place.contains(at) ? at.dataset.column : undefined;
  place.innerHTML = await answer.text();  // rendered and escaped by this server
  if (focused !== undefined) {  // sorting must keep the keyboard focus
    const again = [...place.querySelectorAll("th button")].find((one) => one.dataset.column === focused);
    if (again) again.focus();
  }
}

export function refreshAll() { return Promise.all([...document.querySelectorAll(".table-block")].map(refresh)); }

document.addEventListener("click", (event) => {
  const head = event.target.closest(".table-block th button");
  if (!head) return;
  const block = head.closest(".table-block"), { column } = head.dataset;
  const down = block.dataset.column === column && block.dataset.down !== "1";
  Object.assign(block.dataset, { column, down: down ? "1" : "" });
  refresh(block);
});

let waiting = null;
document.addEventListener("input", (event) => {
  if (!event.target.matches(".table-block .filter")) return;
  clearTimeout(waiting);
  waiting = setTimeout(() => refresh(event.target.closest(".table-block")), WAIT_MS);
});

document.addEventListener("change", (event) => {
  if (event.target.matches(".choose select")) event.target.form.submit();
});
