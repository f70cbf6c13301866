// One frame on a canvas: height relief, zoomed smoothly, with the skeleton over it, whose joints can be dragged.

const GRAB_PX = 16;  // distance within which the pointer grabs a joint
const EASE_S = 0.09;
const MARGIN = 1.25;  // the requested part of the image, relative to the view
const MOST_ZOOM = 24;
const PATIENCE_MS = 4000;

export class Stage {
  constructor(canvas, source) {
    this.canvas = canvas;
    this.source = source;
    this.context = canvas.getContext("2d");
    this.row = 0;
    this.follow = true;
    this.zoomBy = 1;
    this.goal = null;
    this.view = null;  // u, v: the image pixel in the middle; scale: screen pixels per image pixel
    this.dragged = null;
    this.placed = new Map();  // "row/joint" -> position set by the user, until saved
    this.skeleton = true;
    this.lit = false;
    this.onPlace = () => {};
    this.onDrag = () => {};
    this.onPick = () => {};
    this.last = null;
    this.first = new Promise((resolve) => {  // resolves with the first image, or without one
      this.resolve = resolve;
      setTimeout(resolve, PATIENCE_MS);
    });
    this.onPlaceable = () => true;
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    canvas.addEventListener("pointerup", (event) => this.up(event));
    canvas.addEventListener("pointercancel", () => { this.dragged = null; });
    canvas.addEventListener("touchstart", (event) => {  // a touch on a joint drags it, elsewhere it scrolls the page
      const touch = event.touches[0];
      if (event.touches.length === 1 && this.near(touch.clientX, touch.clientY, 2)) event.preventDefault();
    }, { passive: false });
    canvas.addEventListener("wheel", (event) => {
      if (document.activeElement !== canvas && !event.ctrlKey) return;  // scrolling the page does not zoom
      event.preventDefault();
      this.zoom(Math.exp(-0.0016 * event.deltaY));
    }, { passive: false });
  }

  size() {
    const box = this.canvas.getBoundingClientRect(), dots = window.devicePixelRatio || 1;
    const width = Math.max(1, Math.round(box.width * dots)), height = Math.max(1, Math.round(box.height * dots));
    if (this.canvas.width !== width || this.canvas.height !== height) {
      this.canvas.width = width;
      this.canvas.height = height;
    }
    return { width, height, dots };
  }

  fit() { this.follow = true; this.zoomBy = 1; this.goal = null; }

  whole() { this.follow = false; this.zoomBy = 1; this.goal = null; }

  zoom(by) { this.zoomBy = Math.min(Math.max(this.zoomBy * by, 0.1), 8); }

  wanted(row) {  // the view of a frame
    const { width, height } = this.size(), about = this.source.about;
    const whole = Math.min(width / about.width, height / about.height);
    const data = this.source.at(row), middle = data && data.animals[0].middle;
    const half = about.animals[0].half_px;
    const base = this.follow ? Math.min(width, height) / (2 * half) : whole;
    const scale = Math.min(Math.max(base * this.zoomBy, whole), MOST_ZOOM * (window.devicePixelRatio || 1));
    const here = this.follow && middle ? { u: middle[0], v: middle[1] } : this.goal || (this.follow && this.view)
      || { u: about.width / 2 - 0.5, v: about.height / 2 - 0.5 };
    return { u: here.u, v: here.v, scale };
  }

  boxOf(view) {
    const { width, height } = this.size();
    const w = MARGIN * width / view.scale, h = MARGIN * height / view.scale;
    return this.source.boxOf({ left: view.u + 0.5 - w / 2, top: view.v + 0.5 - h / 2, width: w, height: h });
  }

  ready(row) {
    const data = this.source.at(row);
    return Boolean(data && this.source.image(row, this.tight(this.wanted(row))));
  }

  tight(view) {  // the visible part of the image
    const { width, height } = this.size(), about = this.source.about;
    const left = Math.max(0, Math.floor(view.u + 0.5 - width / 2 / view.scale));
    const top = Math.max(0, Math.floor(view.v + 0.5 - height / 2 / view.scale));
    const right = Math.min(about.width, Math.ceil(view.u + 0.5 + width / 2 / view.scale));
    const bottom = Math.min(about.height, Math.ceil(view.v + 0.5 + height / 2 / view.scale));
    return [left, top, Math.max(1, right - left), Math.max(1, bottom - top)];
  }

  prefetch(row, step, n) {
    for (let k = 1; k <= n; k += 1) {
      const next = row + k * step;
      if (next < this.source.times.length && this.source.at(next)) this.source.want(next, this.boxOf(this.wanted(next)));
    }
  }

  draw(row, seconds) {
    this.row = row;
    const target = this.wanted(row);
    const far = this.view && Math.hypot(target.u - this.view.u, target.v - this.view.v) * target.scale > 0.5 * this.canvas.width;
    if (!this.view || far || window.matchMedia("(prefers-reduced-motion: reduce)").matches) this.view = target;
    const share = 1 - Math.exp(-seconds / EASE_S);
    this.view = {
      u: this.view.u + (target.u - this.view.u) * share, v: this.view.v + (target.v - this.view.v) * share,
      scale: this.view.scale * (target.scale / this.view.scale) ** share,
    };
    this.source.want(row, this.boxOf(target), true);
    const cached = this.source.image(row, this.tight(target)) || this.source.images.get(row);
    if (cached && cached.image.complete && cached.image.naturalWidth) this.last = { row, ...cached };
    this.paint();
    if (this.last) requestAnimationFrame(() => this.resolve());
    return Math.hypot(target.u - this.view.u, target.v - this.view.v) * this.view.scale < 0.3
      && Math.abs(Math.log(target.scale / this.view.scale)) < 1e-3;
  }

  at(u, v) {
    const { u: mu, v: mv, scale } = this.view;
    return [(u - mu) * scale + this.canvas.width / 2, (v - mv) * scale + this.canvas.height / 2];
  }

  pixel(clientX, clientY) {
    const box = this.canvas.getBoundingClientRect(), dots = this.canvas.width / box.width;
    const { u, v, scale } = this.view;
    return [u + ((clientX - box.left) * dots - this.canvas.width / 2) / scale,
      v + ((clientY - box.top) * dots - this.canvas.height / 2) / scale];
  }

  uvOf(animal) {  // its joints, with the positions set by the user
    const data = this.source.at(this.row), uv = data && data.animals[animal].uv;
    if (!uv || uv.some((one) => one[0] === null)) return null;
    return uv.map((one, j) => this.placed.get(`${this.row}/${j}`)
      || (this.dragged && this.dragged.animal === animal && this.dragged.joint === j ? this.dragged.to : one));
  }

  paint() {
    const { width, height, dots } = this.size(), context = this.context;
    context.fillStyle = "#22262a";
    context.fillRect(0, 0, width, height);
    if (this.last && this.last.row === this.row) {
      const [left, top, w, h] = this.last.box, [x, y] = this.at(left - 0.5, top - 0.5);
      context.imageSmoothingEnabled = true;
      context.imageSmoothingQuality = "high";
      context.drawImage(this.last.image, x, y, w * this.view.scale, h * this.view.scale);
    }
    const data = this.source.at(this.row);
    if (this.skeleton && data) {
      let posed = false;
      data.animals.forEach((_, animal) => {
        const uv = this.uvOf(animal);
        posed = posed || uv !== null;
        if (uv) this.bones(uv, animal, dots, ["doubtful", "unclear"].includes(data.flag));
      });
      if (!posed) this.note("no pose in this frame", dots);
    }
    if (this.lit) {
      context.strokeStyle = "#ffd24a";
      context.lineWidth = 8 * dots;
      context.strokeRect(4 * dots, 4 * dots, width - 8 * dots, height - 8 * dots);
    }
  }

  bones(uv, animal, dots, doubtful) {
    const context = this.context, about = this.source.about, tip = uv.length - 1;
    const lines = (colour, wide) => {
      context.strokeStyle = colour;
      context.lineWidth = wide * dots;
      context.beginPath();
      about.bones.forEach(([a, b]) => {
        context.moveTo(...this.at(...uv[a]));
        context.lineTo(...this.at(...uv[b]));
      });
      context.stroke();
    };
    lines("rgba(0, 0, 0, 0.55)", 4.5);
    lines(doubtful ? "#ffb347" : "#ffffff", 2);
    uv.forEach((one, j) => {
      const held = this.dragged && this.dragged.animal === animal && this.dragged.joint === j;
      const waits = this.placed.has(`${this.row}/${j}`);
      context.beginPath();
      context.arc(...this.at(...one), (held ? 8 : 5.5) * dots, 0, 2 * Math.PI);
      context.fillStyle = held || waits ? "#ffd24a" : j === tip ? "#e0483e" : "#ffffff";
      context.fill();
      context.lineWidth = 1.2 * dots;
      context.strokeStyle = "#222";
      context.stroke();
      const where = held && this.dragged.label ? `, ${this.dragged.label}` : "";
      if (held || this.hover === j) this.label(`${about.joints[j]}${where}`, one, dots);
    });
  }

  label(text, uv, dots) {
    const [x, y] = this.at(...uv), context = this.context;
    context.font = `600 ${13 * dots}px system-ui, sans-serif`;
    const wide = context.measureText(text).width;
    context.fillStyle = "rgba(0, 0, 0, 0.65)";
    context.fillRect(x + 11 * dots, y - 23 * dots, wide + 10 * dots, 19 * dots);
    context.fillStyle = "#fff";
    context.fillText(text, x + 16 * dots, y - 9 * dots);
  }

  note(text, dots) {
    const context = this.context;
    context.font = `${13 * dots}px system-ui, sans-serif`;
    const wide = context.measureText(text).width;
    context.fillStyle = "rgba(0, 0, 0, 0.6)";
    context.fillRect(this.canvas.width / 2 - wide / 2 - 8 * dots, 10 * dots, wide + 16 * dots, 24 * dots);
    context.fillStyle = "#fff";
    context.fillText(text, this.canvas.width / 2 - wide / 2, 27 * dots);
  }

  near(clientX, clientY, reach = 1) {  // the joint under the pointer
    if (!this.view || !this.skeleton || !this.onPlaceable()) return null;
    const box = this.canvas.getBoundingClientRect(), dots = this.canvas.width / box.width;
    const x = (clientX - box.left) * dots, y = (clientY - box.top) * dots;
    let best = null, least = GRAB_PX * dots * reach;
    this.source.about.animals.forEach((_, animal) => (this.uvOf(animal) || []).forEach((uv, joint) => {
      const [px, py] = this.at(...uv), away = Math.hypot(px - x, py - y);
      if (away < least) { least = away; best = { animal, joint }; }
    }));
    return best;
  }

  down(event) {
    if (event.button) return;
    this.canvas.focus({ preventScroll: true });
    const near = this.near(event.clientX, event.clientY);
    const [u, v] = this.pixel(event.clientX, event.clientY);
    if (near) {
      this.canvas.setPointerCapture(event.pointerId);
      const from = this.uvOf(near.animal)[near.joint];
      this.dragged = { ...near, row: this.row, off: [from[0] - u, from[1] - v], to: from, began: [event.clientX, event.clientY] };
    } else if (event.pointerType === "mouse") {
      this.panned = { u, v, began: [event.clientX, event.clientY], moved: false };
    }
    this.changed();
  }

  move(event) {
    const [u, v] = this.view ? this.pixel(event.clientX, event.clientY) : [0, 0];
    if (this.dragged) {
      this.dragged.to = [u + this.dragged.off[0], v + this.dragged.off[1]];
      this.onDrag(this.dragged);
    } else if (this.panned) {
      const away = Math.hypot(event.clientX - this.panned.began[0], event.clientY - this.panned.began[1]);
      if (!this.panned.moved && away < 5) return;
      if (!this.panned.moved) {  // from here on the user controls the view, at its current zoom
        this.panned.moved = true;
        const now = this.view.scale;
        this.follow = false;
        this.goal = { u: this.view.u, v: this.view.v };
        this.zoomBy *= now / this.wanted(this.row).scale;
      }
      this.goal = { u: this.view.u - (u - this.panned.u), v: this.view.v - (v - this.panned.v) };
      this.view = { ...this.view, ...this.goal };
    } else {
      const near = this.near(event.clientX, event.clientY);
      this.hover = near ? near.joint : null;
      this.canvas.style.cursor = near ? "grab" : "default";
    }
    this.changed();
  }

  up(event) {
    const dragged = this.dragged, panned = this.panned;
    this.dragged = null;
    this.panned = null;
    if (dragged) {
      const away = Math.hypot(event.clientX - dragged.began[0], event.clientY - dragged.began[1]);
      if (away < 3) this.onPick(this.pixel(event.clientX, event.clientY));
      else if (dragged.row === this.row) this.onPlace(dragged.row, dragged.joint, dragged.to);
    } else if (panned && !panned.moved) {
      this.onPick(this.pixel(event.clientX, event.clientY));
    }
    this.changed();
  }

  cancel() { this.dragged = null; this.panned = null; this.changed(); }

  changed() {}
}
