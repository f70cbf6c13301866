// Playback: selects the displayed frame, at 0.25 to 4 times the speed of the recording.

export const SPEEDS = [0.25, 0.5, 1, 2, 4];
const AHEAD = 14;  // images that are requested ahead
const LONGEST_S = 0.1;  // longest time step per screen update

export class Player {
  constructor(source, stage) {
    this.source = source;
    this.stage = stage;
    this.row = 0;
    this.speed = 1;
    this.playing = false;
    this.time = 0;
    this.loop = null;  // [first, last] rows of the loop
    this.shown = () => {};
    this.stopped = () => {};
    this.closed = false;
    this.before = null;
    this.awake = true;
    stage.changed = source.changed = () => this.wake();
    new ResizeObserver(() => this.wake()).observe(stage.canvas);
    requestAnimationFrame((now) => this.frame(now));
  }

  wake() {
    if (this.awake || this.closed) return;
    this.awake = true;
    this.before = null;
    requestAnimationFrame((now) => this.frame(now));
  }

  get last() { return this.source.times.length - 1; }

  get step() {  // fast playback skips frames
    return Math.max(1, Math.round(this.speed * (1 / this.source.about.frame_s) / 30));
  }

  go(row) {
    this.row = Math.min(Math.max(row, 0), this.last);
    this.time = this.source.times[this.row];
    if (!this.playing) this.source.drop();
    this.shown(this.row);
    this.wake();
  }

  play(on) {
    if (on && !this.loop && this.row >= this.last) this.go(0);
    if (this.playing === on) return;
    this.playing = on;
    this.time = this.source.times[this.row];
    if (!on) { this.source.drop(); this.stopped(this.row); }
    this.shown(this.row);
    this.wake();
  }

  faster(by) {
    const k = SPEEDS.indexOf(this.speed) + by;
    this.speed = SPEEDS[Math.min(Math.max(k, 0), SPEEDS.length - 1)];
    this.shown(this.row);
  }

  advance(seconds) {
    const end = this.loop ? this.loop[1] : this.last;
    const time = this.time + seconds * this.speed;
    let next = this.row;
    while (next < end && this.source.times[next + 1] <= time + 1e-6) next += 1;
    if (next > this.row) {
      next = next >= end ? end : this.row + Math.ceil((next - this.row) / this.step) * this.step;
      next = Math.min(next, end);
    }
    this.stage.prefetch(this.row, this.step, AHEAD);
    if (next === this.row) {
      this.time = time;
      if (this.row < end) return;
      if (!this.loop) { this.play(false); return; }
      next = this.loop[0];  // from the beginning
      this.time = this.source.times[next];
    } else {
      if (!this.stage.ready(next)) {  // the time stops until its image is loaded
        this.source.want(next, this.stage.boxOf(this.stage.wanted(next)), true);
        return;
      }
      this.time = Math.max(time, this.source.times[next]);
    }
    this.row = next;
    this.shown(next);
  }

  frame(now) {
    if (this.closed || !this.stage.canvas.isConnected) { this.closed = true; return; }
    const seconds = this.before === null ? 0.016 : Math.min((now - this.before) / 1000, LONGEST_S);
    this.before = now;
    if (this.playing) this.advance(seconds);
    const still = this.stage.draw(this.row, seconds);
    this.awake = this.playing || !still;
    if (this.awake) requestAnimationFrame((next) => this.frame(next));
  }
}
