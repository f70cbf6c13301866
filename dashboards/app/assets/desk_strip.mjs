// Two timelines below the image: the whole session, and the seconds around the moment, with bouts, doubtful stretches and a mark.

const AROUND_S = 5;
const GREY = "#c9cbc6";

export class Strip {
  constructor(canvas, near) {
    this.canvas = canvas;
    this.near = near;
    this.bouts = [];
    this.doubts = [];
    this.colours = new Map();
    this.duration = 1;
    this.now = 0;
    this.span = [null, null];
    this.go = () => {};
    this.mark = () => {};
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.from = near ? this.timeAt(event) : null;
      this.held = true;
      if (!near) this.go(this.timeAt(event));
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!this.held) return;
      const at = this.timeAt(event);
      if (!near) this.go(at);
      else if (Math.abs(at - this.from) > 0.08) { this.drawn = true; this.mark(Math.min(at, this.from), Math.max(at, this.from)); }
    });
    const end = (event) => {
      if (this.held && near && !this.drawn && event.type === "pointerup") this.go(this.timeAt(event));
      this.held = this.drawn = false;
    };
    canvas.addEventListener("pointerup", end);
    canvas.addEventListener("pointercancel", end);
    new ResizeObserver(() => this.paint()).observe(canvas);
  }

  limits() {
    if (this.near) return [this.middle() - AROUND_S, this.middle() + AROUND_S];
    return [0, Math.max(this.duration, 1e-3)];
  }

  middle() { return this.held && this.stood !== undefined ? this.stood : this.now; }

  timeAt(event) {
    if (!this.held) this.stood = this.now;
    const box = this.canvas.getBoundingClientRect(), [a, b] = this.limits();
    return Math.min(Math.max(a + (event.clientX - box.left) / box.width * (b - a), 0), this.duration);
  }

  paint() {
    const box = this.canvas.getBoundingClientRect(), dots = window.devicePixelRatio || 1;
    const width = Math.max(1, Math.round(box.width * dots)), height = Math.max(1, Math.round(box.height * dots));
    if (this.canvas.width !== width || this.canvas.height !== height) { this.canvas.width = width; this.canvas.height = height; }
    const context = this.canvas.getContext("2d"), style = getComputedStyle(this.canvas), [a, b] = this.limits();
    const x = (time) => (time - a) / (b - a) * width;
    context.fillStyle = style.getPropertyValue("--soft") || "#eee";
    context.fillRect(0, 0, width, height);
    const foot = 6 * dots, top = height - foot;
    this.bouts.forEach((bout) => {
      if (bout.stop_s < a || bout.start_s > b) return;
      const from = Math.max(x(bout.start_s), 0), wide = Math.max(Math.min(x(bout.stop_s), width) - from, 0.6 * dots);
      context.fillStyle = this.colours.get(bout.action) || GREY;
      context.fillRect(from, 0, wide, top);
      if (this.near && wide > 46 * dots) {
        context.save();
        context.beginPath();
        context.rect(from, 0, wide - 3 * dots, top);
        context.clip();
        context.font = `${12 * dots}px system-ui, sans-serif`;
        context.fillStyle = dark(context.fillStyle) ? "#fff" : "#111";
        context.fillText(bout.action.replaceAll("_", " "), from + 5 * dots, top / 2 + 4 * dots);
        context.restore();
      }
    });
    context.fillStyle = style.getPropertyValue("--warn") || "#8a4b00";
    this.doubts.forEach((doubt) => {
      if (doubt.done || doubt.stop_s < a || doubt.start_s > b) return;
      context.fillRect(x(doubt.start_s), top + dots, Math.max(x(doubt.stop_s) - x(doubt.start_s), 2 * dots), foot - dots);
    });
    const [from, to] = this.span, ink = style.getPropertyValue("--ink") || "#111";
    if (from !== null || to !== null) {
      const low = from === null ? to : from, high = to === null ? from : to;
      context.strokeStyle = ink;
      context.lineWidth = 2 * dots;
      context.setLineDash([5 * dots, 3 * dots]);
      context.strokeRect(x(low), dots, Math.max(x(high) - x(low), 1), top - 2 * dots);
      context.setLineDash([]);
    }
    context.fillStyle = ink;
    context.fillRect(x(this.now) - dots, 0, 2 * dots, height);
  }
}

function dark(colour) {
  const [r, g, b] = [1, 3, 5].map((k) => parseInt(colour.slice(k, k + 2), 16));
  return 0.299 * r + 0.587 * g + 0.114 * b < 140;
}
