// Draws the unrolled skin: circles for normal force, arrows for shear, as in the paper's Figure 1.

import { fit } from "/chart.js";

const FULL_N = 3; // force on a taxel whose circle reaches its neighbours
const LEAST_N = 0.04; // below, a taxel is a dot
const LEAST_SHEAR_N = 0.08;
const MARGIN_MM = 7, GAP = 18, HEAD = 24, FOOT = 26, MAX_HEIGHT = 400, MAX_SCALE = 7.5;
const FONT = 'system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif';
// Order around the finger from its right rear corner, as seen from outside.
const ORDER = { right: 0, tip: 1, left: 2, none: 3 };

export class Skin {
  constructor(canvas, tip) {
    this.canvas = canvas;
    this.tip = tip;
    this.layout = null;
    this.places = [];
    this.taxels = null;
    this.bits = [];
    canvas.setAttribute("role", "img");
    canvas.addEventListener("pointermove", (event) => this.#point(event));
    canvas.addEventListener("pointerdown", (event) => this.#point(event));
    canvas.addEventListener("pointerleave", () => { this.pointed = null; tip.hidden = true; });
  }

  describe(layout, bits) {
    this.layout = layout;
    this.bits = bits;
    this.arrays = layout.arrays.map((array) => {
      const xs = array.xy.map((p) => p[0]), ys = array.xy.map((p) => p[1]);
      const box = [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
      return { ...array, box, w: box[2] - box[0] + 2 * MARGIN_MM, h: box[3] - box[1] + 2 * MARGIN_MM,
        pitch: pitchOf(array.xy) };
    });
    const sides = new Set(this.arrays.map((a) => a.side));
    if (sides.size === this.arrays.length)
      this.arrays.sort((a, b) => (ORDER[a.side] ?? 4) - (ORDER[b.side] ?? 4));
    this.canvas.setAttribute("aria-label", `Skin of ${layout.taxels} taxels in ${this.arrays.length} arrays`);
  }

  // Choose the number of rows that gives the largest picture.
  #arrange(width) {
    let best = null;
    const n = this.arrays.length;
    for (let perRow = 1; perRow <= n; perRow++) {
      const rows = [];
      for (let i = 0; i < n; i += perRow) rows.push(this.arrays.slice(i, i + perRow));
      const wide = Math.min(...rows.map((r) => (width - GAP * (r.length - 1)) / sum(r.map((a) => a.w))));
      const tall = (MAX_HEIGHT - FOOT - rows.length * (HEAD + 8)) / sum(rows.map((r) => Math.max(...r.map((a) => a.h))));
      const scale = Math.min(wide, tall, MAX_SCALE);
      // Prefer one row: neighbours on the skin are then neighbours in the picture.
      const worth = scale * (rows.length === 1 ? 1.25 : 1);
      if (scale > 0 && (!best || worth > best.worth)) best = { rows, scale, worth };
    }
    return best;
  }

  draw(taxels, sides, colour) {
    this.taxels = taxels;
    if (!this.layout) {
      const { pen, width } = fit(this.canvas, 120);
      pen.font = "14px " + FONT;
      pen.fillStyle = colour.muted;
      pen.textAlign = "center";
      pen.fillText("where the taxels are is not known yet", width / 2, 62);
      return;
    }
    const wide = this.canvas.clientWidth;
    const plan = this.#arrange(wide);
    if (!plan) return;
    const { rows, scale } = plan;
    const tall = sum(rows.map((r) => Math.max(...r.map((a) => a.h)) * scale + HEAD + 8)) + FOOT;
    const { pen } = fit(this.canvas, Math.round(tall));
    this.places = [];
    const masked = new Map(taxels ? taxels.masked : []);
    let y = 0, unit = 0;
    for (const row of rows) {
      const height = Math.max(...row.map((a) => a.h)) * scale;
      const taken = sum(row.map((a) => a.w)) * scale + GAP * (row.length - 1);
      let x = (wide - taken) / 2;
      for (const array of row) {
        const top = y + HEAD + (height - array.h * scale) / 2;
        this.#outline(pen, array, x, top, scale, sides, colour);
        unit = array.pitch * scale;
        for (let i = 0; i < array.xy.length; i++) {
          const px = x + (array.xy[i][0] - array.box[0] + MARGIN_MM) * scale;
          const py = top + (array.box[3] - array.xy[i][1] + MARGIN_MM) * scale;
          this.places.push({ index: array.first + i, array: array.name, number: i, x: px, y: py, unit });
        }
        x += array.w * scale + GAP;
      }
      y += height + HEAD + 8;
    }
    for (const place of this.places) this.#dot(pen, place, masked, colour);
    if (taxels) {
      for (const place of this.places) this.#circle(pen, place, taxels, masked, colour);
      for (const place of this.places) this.#arrow(pen, place, taxels, masked, colour);
    }
    this.#legend(pen, Math.min(unit || 20, 26), y + 14, masked.size > 0, wide, colour);
    if (this.pointed) this.#tell();
  }

  #outline(pen, array, x, y, scale, sides, colour) {
    pen.fillStyle = colour.soft;
    pen.strokeStyle = colour.line;
    pen.lineWidth = 1.5;
    if (!array.posed) pen.setLineDash([5, 4]);
    pen.beginPath();
    pen.roundRect(x, y, array.w * scale, array.h * scale, 10);
    pen.fill();
    pen.stroke();
    pen.setLineDash([]);
    pen.textAlign = "left";
    pen.font = "600 13px " + FONT;
    pen.fillStyle = colour[array.side] || colour.ink;
    const label = array.name === array.side || array.side === "none" ? array.name : `${array.name}, ${array.side}`;
    let text = label;
    while (text.length > 2 && pen.measureText(text).width > array.w * scale - 4) text = text.slice(0, -2) + "…";
    pen.fillText(text, x + 2, y - 8);
    const room = array.w * scale - pen.measureText(text).width;
    pen.font = "12px " + FONT;
    pen.fillStyle = colour.muted;
    const side = sides[array.side];
    const alone = this.arrays.filter((a) => a.side === array.side).length === 1;
    if (alone && side > 0.005 && room > 60) {
      pen.textAlign = "right";
      pen.fillText(`${side.toFixed(2)} N`, x + array.w * scale - 2, y - 8);
    }
  }

  #dot(pen, place, masked, colour) {
    const size = Math.max(1.6, Math.min(place.unit * 0.08, 3.2));
    if (masked.has(place.index)) {
      const arm = Math.max(3, Math.min(place.unit * 0.2, 8));
      pen.strokeStyle = colour.masked;
      pen.lineWidth = 2;
      pen.beginPath();
      pen.moveTo(place.x - arm, place.y - arm);
      pen.lineTo(place.x + arm, place.y + arm);
      pen.moveTo(place.x - arm, place.y + arm);
      pen.lineTo(place.x + arm, place.y - arm);
      pen.stroke();
      return;
    }
    pen.fillStyle = colour.muted;
    pen.globalAlpha = 0.55;
    pen.beginPath();
    pen.arc(place.x, place.y, size, 0, 7);
    pen.fill();
    pen.globalAlpha = 1;
  }

  #circle(pen, place, taxels, masked, colour) {
    const force = -taxels.f[3 * place.index + 2] / 1000;
    if (masked.has(place.index) || !(force > LEAST_N)) return;
    const radius = radiusOf(force, place.unit);
    const bound = taxels.b[place.index] / 1000;
    if (bound > 0 && bound <= force) {
      // The ring between the circles of the least and the greatest possible force.
      const outer = radiusOf(force + bound, place.unit), inner = radiusOf(Math.max(force - bound, 0), place.unit);
      pen.globalAlpha = 0.16;
      pen.fillStyle = colour.accent;
      pen.beginPath();
      pen.arc(place.x, place.y, outer, 0, 7);
      pen.arc(place.x, place.y, inner, 0, 7, true);
      pen.fill("evenodd");
    }
    // A force that may be zero is drawn faintly.
    const sure = !(bound > force);
    pen.globalAlpha = sure ? 0.5 : 0.22;
    pen.fillStyle = colour.accent;
    pen.beginPath();
    pen.arc(place.x, place.y, radius, 0, 7);
    pen.fill();
    pen.globalAlpha = 1;
    if (!sure) return;
    pen.strokeStyle = colour.accent;
    pen.lineWidth = 1.4;
    pen.stroke();
  }

  #arrow(pen, place, taxels, masked, colour) {
    const fx = taxels.f[3 * place.index] / 1000, fy = taxels.f[3 * place.index + 1] / 1000;
    const normal = -taxels.f[3 * place.index + 2] / 1000;
    const shear = Math.hypot(fx, fy);
    if (masked.has(place.index) || shear < LEAST_SHEAR_N || normal < LEAST_N) return;
    if (taxels.b[place.index] / 1000 > normal) return;
    const length = arrowOf(shear, place.unit);
    arrow(pen, place.x, place.y, place.x + (fx / shear) * length, place.y - (fy / shear) * length, colour.shear);
  }

  #legend(pen, unit, y, masked, width, colour) {
    pen.font = "12px " + FONT;
    pen.textAlign = "left";
    let x = 6;
    const say = (text) => {
      pen.fillStyle = colour.muted;
      pen.fillText(text, x, y + 4);
      x += pen.measureText(text).width + 18;
    };
    const radius = Math.min(radiusOf(0.5, unit), 9);
    pen.globalAlpha = 0.5;
    pen.fillStyle = colour.accent;
    pen.beginPath();
    pen.arc(x + radius, y, radius, 0, 7);
    pen.fill();
    pen.globalAlpha = 1;
    pen.strokeStyle = colour.accent;
    pen.lineWidth = 1.4;
    pen.stroke();
    x += 2 * radius + 6;
    say(width < 420 ? "normal" : "normal force");
    arrow(pen, x, y, x + 18, y, colour.shear);
    x += 24;
    say("shear");
    pen.globalAlpha = 0.2;
    pen.strokeStyle = colour.accent;
    pen.lineWidth = 4;
    pen.beginPath();
    pen.arc(x + 7, y, 6, 0, 7);
    pen.stroke();
    pen.globalAlpha = 1;
    x += 20;
    say(width < 420 ? "bound" : "95 % bound");
    if (masked) {
      pen.strokeStyle = colour.masked;
      pen.lineWidth = 2;
      pen.beginPath();
      pen.moveTo(x, y - 5);
      pen.lineTo(x + 10, y + 5);
      pen.moveTo(x, y + 5);
      pen.lineTo(x + 10, y - 5);
      pen.stroke();
      x += 16;
      say("masked");
    }
  }

  #point(event) {
    const box = this.canvas.getBoundingClientRect();
    const x = event.clientX - box.left, y = event.clientY - box.top;
    let best = null, least = Infinity;
    for (const place of this.places) {
      const away = Math.hypot(place.x - x, place.y - y);
      if (away < least) [best, least] = [place, away];
    }
    this.pointed = best && least < Math.max(best.unit * 0.7, 14) ? best.index : null;
    if (this.pointed === null) this.tip.hidden = true;
    else this.#tell();
  }

  #tell() {
    const place = this.places.find((each) => each.index === this.pointed);
    if (!place || !this.taxels) return;
    const { f, b, masked } = this.taxels;
    const status = masked.find(([index]) => index === place.index);
    const lines = [`${place.array}, taxel ${place.number}`];
    if (status) {
      const why = this.bits.filter(([bit]) => status[1] & bit).map(([, word]) => word);
      lines.push(`masked: ${why.join(", ") || "unhealthy"}`);
    } else {
      const normal = -f[3 * place.index + 2] / 1000, bound = b[place.index];
      lines.push(`normal ${normal.toFixed(2)}${bound > 0 ? ` ± ${(bound / 1000).toFixed(2)}` : ""} N`);
      lines.push(`shear ${(f[3 * place.index] / 1000).toFixed(2)}, ${(f[3 * place.index + 1] / 1000).toFixed(2)} N`);
    }
    this.tip.textContent = lines.join("\n");
    this.tip.hidden = false;
    const wide = this.canvas.clientWidth;
    const at = Math.min(Math.max(place.x - this.tip.offsetWidth / 2, 0), wide - this.tip.offsetWidth);
    this.tip.style.left = at + "px";
    const above = place.y - this.tip.offsetHeight - 14;
    this.tip.style.top = (above > 0 ? above : place.y + 16) + "px";
  }
}

export function arrow(pen, x0, y0, x1, y1, colour, width = 2) {
  const angle = Math.atan2(y1 - y0, x1 - x0), length = Math.hypot(x1 - x0, y1 - y0);
  const head = Math.min(8, length * 0.6 + 2);
  pen.strokeStyle = pen.fillStyle = colour;
  pen.lineWidth = width;
  pen.beginPath();
  pen.moveTo(x0, y0);
  pen.lineTo(x1 - Math.cos(angle) * head * 0.7, y1 - Math.sin(angle) * head * 0.7);
  pen.stroke();
  pen.beginPath();
  pen.moveTo(x1, y1);
  pen.lineTo(x1 - head * Math.cos(angle - 0.45), y1 - head * Math.sin(angle - 0.45));
  pen.lineTo(x1 - head * Math.cos(angle + 0.45), y1 - head * Math.sin(angle + 0.45));
  pen.fill();
}

function radiusOf(force, unit) {
  // The area is proportional to the force.
  return Math.min(Math.sqrt(force / FULL_N) * unit * 0.75, unit * 1.25);
}

function arrowOf(shear, unit) {
  return Math.min(6 + shear * unit * 0.9, unit * 2.4);
}

function pitchOf(xy) {
  let least = Infinity;
  for (let i = 0; i < Math.min(xy.length, 64); i++)
    for (let j = 0; j < i; j++) least = Math.min(least, Math.hypot(xy[i][0] - xy[j][0], xy[i][1] - xy[j][1]));
  return Number.isFinite(least) && least > 0.1 ? least : 10;
}

function sum(values) { return values.reduce((a, b) => a + b, 0); }
