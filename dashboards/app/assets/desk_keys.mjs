// The keys of the correction page: a list for users, and their actions.

export const KEYS = [
  ["space", "play or pause"], ["← →", "one frame; with Shift one second"], ["↑ ↓", "bout before, bout after"],
  [", .", "slower, faster"], ["1 to 9", "name the bout here, or the marked span; with Shift from the tenth on"], ["0", "take the bout's name away"],
  ["[ ]", "mark a span from here, to here; Esc clears it"], ["F", "exchange head and tail in the span, or here"],
  ["N P", "next, previous doubtful frame"], ["K", "correct as is: next"],
  ["X", "next crossing: ends or animals taken for one another; with Shift the one before"], ["U R", "take back; make again what was taken back"],
  ["+ − Z", "zoom in, out; all of the image"], ["S", "skeleton on, off"],
];

export function typing(event) {  // a key for a field or a list, not for the page
  const at = event.target;
  if (event.ctrlKey || event.metaKey || event.altKey || event.defaultPrevented) return true;
  if (at.closest && at.closest("input, textarea, select, [contenteditable]")) return true;
  return [" ", "Enter"].includes(event.key) && Boolean(at.closest && at.closest("button, a, summary"));
}

export function keyOf(k) { return k < 9 ? String(k + 1) : k < 18 ? `⇧${k - 8}` : ""; }  // of the k-th action

export function actOf(desk, event) {  // the action of a key on the desk; undefined if it has none
  const { player, stage } = desk;
  const seconds = (by) => desk.source.rowAt(desk.time() + by);
  const go = (row) => { player.play(false); player.go(row); };
  const bout = (way) => {
    const time = desk.time(), starts = desk.bouts.map((one) => one.start_s);
    const found = way > 0 ? starts.find((one) => one > time + 1e-3) : starts.filter((one) => one < time - 1e-3).pop();
    if (found !== undefined) go(desk.source.rowAt(found));
  };
  const acts = {
    " ": () => player.play(!player.playing),
    ArrowLeft: () => go(event.shiftKey ? seconds(-1) : player.row - 1),
    ArrowRight: () => go(event.shiftKey ? seconds(1) : player.row + 1),
    ArrowUp: () => bout(-1), ArrowDown: () => bout(1),
    ",": () => player.faster(-1), ".": () => player.faster(1),
    "[": () => desk.mark(0), "]": () => desk.mark(1),
    Escape: () => { stage.cancel(); desk.markSpan(null, null); desk.notify(""); },
    f: () => desk.flip(), u: () => desk.clerk.undo(), r: () => desk.clerk.redo(),
    n: () => desk.doubts.next(1), p: () => desk.doubts.next(-1), k: () => desk.doubts.right(),
    x: () => desk.crossings.next(event.shiftKey ? -1 : 1),
    z: () => desk.view(), "+": () => stage.zoom(1.25), "=": () => stage.zoom(1.25), "-": () => stage.zoom(0.8),
    s: () => { stage.skeleton = !stage.skeleton; },
  };
  const digit = /^[0-9]$/.test(event.key) ? Number(event.key) : null, code = /^Digit([1-9])$/.exec(event.code);
  const act = acts[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (digit === 0) return () => desk.unname();
  if (digit !== null) return () => desk.number(digit - 1);
  return !act && code && event.shiftKey ? () => desk.number(Number(code[1]) + 8) : act;
}
