// Draws the forces of the last seconds as curves.

export function colours() {
  const style = getComputedStyle(document.documentElement);
  return new Proxy({}, { get: (_, name) => style.getPropertyValue("--" + name).trim() });
}

export function fit(canvas, height) {
  // Use the screen's resolution; drawing is in CSS pixels.
  const width = canvas.clientWidth, ratio = Math.min(window.devicePixelRatio || 1, 3);
  const w = Math.round(width * ratio), h = Math.round(height * ratio);
  if (canvas.width !== w || canvas.height !== h) {
    canvas.width = w;
    canvas.height = h;
    canvas.style.height = height + "px";
  }
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  return { pen, width, height };
}

const FONT = '12px system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif';
const SIDES = ["left", "right", "tip"];
const STEPS = [0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000];

export class Chart {
  constructor(canvas, span) {
    this.canvas = canvas;
    this.span = span;
    this.points = []; // [t, total, left, right, tip]
    this.top = 1;
  }

  load(points) { this.points = points.slice(); }

  add(t, total, sides) {
    const last = this.points.at(-1);
    if (last && t < last[0]) this.points.length = 0; // a jump to another place of a log
    if (last && t === last[0]) return;
    this.points.push([t, total, ...SIDES.map((side) => sides[side] || 0)]);
    let old = 0;
    while (old < this.points.length && this.points[old][0] < t - this.span - 1) old++;
    if (old > 64) this.points.splice(0, old);
  }

  draw(now, shown, colour) {
    const { pen, width, height } = fit(this.canvas, 132);
    const left = 40, right = 8, top = 20, bottom = 20;
    const points = this.points;
    let most = 0.5;
    for (const p of points) if (p[0] >= now - this.span && p[1] > most) most = p[1];
    const goal = most * 1.12;
    // The scale grows at once and shrinks slowly: one that jumps cannot be read.
    this.top = goal > this.top ? goal : Math.max(goal, this.top * 0.985);
    const step = STEPS.find((s) => this.top / s <= 3.6) || 2000;
    const x = (t) => left + (1 - (now - t) / this.span) * (width - left - right);
    const y = (f) => height - bottom - (Math.max(f, 0) / this.top) * (height - top - bottom);
    pen.font = FONT;
    pen.lineWidth = 1;
    pen.textBaseline = "middle";
    pen.textAlign = "right";
    for (let f = 0; f <= this.top; f += step) {
      pen.strokeStyle = colour.line;
      pen.beginPath();
      pen.moveTo(left, Math.round(y(f)) + 0.5);
      pen.lineTo(width - right, Math.round(y(f)) + 0.5);
      pen.stroke();
      pen.fillStyle = colour.muted;
      pen.fillText(step < 1 ? f.toFixed(1) : String(Math.round(f)), left - 7, y(f));
    }
    pen.textBaseline = "alphabetic";
    pen.fillStyle = colour.muted;
    pen.textAlign = "left";
    pen.fillText("N", left - 14, 11);
    for (let s = 0; s <= this.span; s += 5) {
      pen.textAlign = s === 0 ? "right" : s === this.span ? "left" : "center";
      pen.fillText(s === 0 ? "now" : `−${s} s`, x(now - s), height - 5);
    }
    pen.save();
    pen.beginPath();
    pen.rect(left, 0, width - left - right, height);
    pen.clip();
    const curve = (index) => {
      pen.beginPath();
      let open = false, before = -1e9;
      for (const p of points) {
        if (p[0] < now - this.span - 0.2 || p[0] > now) continue;
        // A pause in the data is a gap in the curve.
        if (open && p[0] - before < 1) pen.lineTo(x(p[0]), y(p[index]));
        else pen.moveTo(x(p[0]), y(p[index]));
        open = true;
        before = p[0];
      }
      pen.stroke();
    };
    pen.lineJoin = "round";
    pen.lineWidth = 1.4;
    if (shown.length > 1) {
      for (const side of shown) {
        const index = SIDES.indexOf(side);
        if (index < 0) continue;
        pen.strokeStyle = colour[side];
        curve(index + 2);
      }
    }
    pen.lineWidth = 2;
    pen.strokeStyle = colour.accent;
    curve(1);
    pen.restore();
    // Legend, upper right.
    const words = [["normal force", "accent"]];
    if (shown.length > 1) for (const side of shown) if (SIDES.includes(side)) words.push([side, side]);
    pen.textAlign = "right";
    let at = width - right;
    for (const [word, name] of words.reverse()) {
      pen.fillStyle = colour.muted;
      pen.fillText(word, at, 11);
      at -= pen.measureText(word).width + 6;
      pen.fillStyle = colour[name];
      pen.fillRect(at - 12, 6, 12, 3);
      at -= 24;
    }
  }
}
