// The frames of a session or of a clip: images and joints, requested ahead and cached.

const ROWS = 512;  // frames per request of joints
const IMAGES = 240;  // in the cache
const AT_ONCE = 4;  // images that are loading
const STEP = 16;  // boxes begin and end at multiples of this, pixels

export async function json(address, options) {
  const answer = await fetch(address, options);
  let content;
  try {
    content = await answer.json();
  } catch {
    throw new Error(answer.ok ? "the dashboard's answer cannot be read" : `the dashboard answered ${answer.status}`);
  }
  if (!answer.ok) throw new Error(content.message || `the dashboard answered ${answer.status}`);
  return content;
}

export class Source {
  constructor(base) {
    this.base = base;
    this.chunks = new Map();
    this.images = new Map();
    this.wanted = [];
    this.loading = 0;
    this.changed = () => {};
  }

  open() {
    this.opening ||= this.begin();
    return this.opening;
  }

  async begin() {
    this.timed = fetch(`${this.base}/times`).then((answer) => answer.arrayBuffer()).then((times) => {
      this.times = new Float64Array(times);
    });
    [this.about] = await Promise.all([json(`${this.base}/about`), this.timed]);
    if (this.about.n === undefined) throw new Error(this.about.message);
    return this.about;
  }

  rowAt(time) {  // the frame nearest in time
    let low = 0, high = this.times.length - 1;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.times[middle] < time) low = middle + 1; else high = middle;
    }
    return low > 0 && time - this.times[low - 1] <= this.times[low] - time ? low - 1 : low;
  }

  chunkOf(row) { return Math.floor(row / ROWS); }

  async load(chunk) {
    const known = this.chunks.get(chunk);
    if (known) return known;
    const coming = json(`${this.base}/rows/${chunk * ROWS}/${(chunk + 1) * ROWS}`).then((rows) => {
      if (this.chunks.get(chunk) === coming) this.chunks.set(chunk, rows);
      this.changed();
      return rows;
    }, () => { this.chunks.delete(chunk); });
    this.chunks.set(chunk, coming);
    return coming;
  }

  at(row) {  // the data of a frame; null until loaded
    const chunk = this.chunkOf(row), rows = this.chunks.get(chunk);
    if (!rows || rows instanceof Promise) {
      this.load(chunk);
      return null;
    }
    const k = row - rows.first;
    if (k % ROWS > ROWS - 90) this.load(chunk + 1);
    return {
      flag: rows.flag[k], error: rows.error_mm[k], pFlip: rows.p_flip[k], frame: rows.frame[k],
      animals: rows.animals.map((one) => ({ uv: one.uv[k], middle: one.middle[k] })),
    };
  }

  forgetRows() {  // after a correction; the old ones are shown until the new ones are loaded
    const before = [...this.chunks.keys()];
    const old = this.chunks;
    this.chunks = new Map([...old].filter(([, rows]) => !(rows instanceof Promise)));
    return Promise.all(before.map(async (chunk) => {
      const rows = await json(`${this.base}/rows/${chunk * ROWS}/${(chunk + 1) * ROWS}`);
      this.chunks.set(chunk, rows);
    })).then(() => this.changed());
  }

  boxOf(view) {  // the part of the image that a view needs, on a grid, so that many frames share one box
    const { width, height } = this.about;
    const left = Math.max(0, Math.floor(view.left / STEP) * STEP), top = Math.max(0, Math.floor(view.top / STEP) * STEP);
    const right = Math.min(width, Math.ceil((view.left + view.width) / STEP) * STEP);
    const bottom = Math.min(height, Math.ceil((view.top + view.height) / STEP) * STEP);
    return [left, top, Math.max(1, right - left), Math.max(1, bottom - top)];
  }

  image(row, box) {  // {image, box} that covers the box; null until loaded
    const known = this.images.get(row);
    if (known && covers(known.box, box)) {
      this.images.delete(row);
      this.images.set(row, known);
      return known.image.complete && known.image.naturalWidth ? known : null;
    }
    return null;
  }

  want(row, box, first = false) {
    const known = this.images.get(row);
    if ((known && covers(known.box, box)) || row < 0 || row >= this.times.length) return;
    this.wanted = this.wanted.filter((one) => one.row !== row);
    if (first) this.wanted.unshift({ row, box }); else this.wanted.push({ row, box });
    this.pump();
  }

  drop() { this.wanted = []; }

  pump() {
    while (this.loading < AT_ONCE && this.wanted.length) {
      const { row, box } = this.wanted.shift();
      const image = new Image();
      const kept = { image, box: [...box] };
      this.images.set(row, kept);
      this.loading += 1;
      const done = () => { this.loading -= 1; this.changed(); this.pump(); };
      image.addEventListener("load", () => {  // it was clipped to the image
        kept.box.splice(2, 2, image.naturalWidth, image.naturalHeight);
        done();
      });
      image.addEventListener("error", () => { if (this.images.get(row) === kept) this.images.delete(row); done(); });
      image.src = `${this.base}/frame/${row}.png?box=${box.join(",")}`;
      while (this.images.size > IMAGES) this.images.delete(this.images.keys().next().value);
    }
  }
}

function covers(outer, inner) {
  return outer[0] <= inner[0] && outer[1] <= inner[1] && outer[0] + outer[2] >= inner[0] + inner[2] && outer[1] + outer[3] >= inner[1] + inner[3];
}
