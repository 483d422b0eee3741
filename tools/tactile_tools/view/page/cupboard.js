// Draws the cupboard from above (x into it is up, y is left): objects, finger, contacts, path.

import { fit } from "/chart.js";
import { arrow } from "/skin.js";

const CYLINDER = 3, METRES_PER_N = 0.008, TRAIL = 4000;

export class Cupboard {
  constructor(canvas) {
    this.canvas = canvas;
    this.trail = [];
    this.box = null;
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", "The cupboard from above");
  }

  draw(reach, boards, shape, colour) {
    const height = Math.max(230, Math.min(this.canvas.clientWidth * 1.02, 460));
    const { pen, width } = fit(this.canvas, Math.round(height));
    const arm = reach.arm, state = reach.state;
    const pose = arm && [arm.x, arm.y, arm.heading].every((v) => v !== null) ? arm : null;
    const ahead = pose && place(pose, shape.tip_x, 0);
    if (ahead) this.#follow(ahead, state);
    const xs = [0, 0.36], ys = [-0.26, 0.26];
    for (const [, , x, y, , sx, sy] of reach.objects) {
      const half = Math.hypot(sx, sy) / 2;
      xs.push(x - (sx > 0.3 ? sx / 2 : Math.min(half, sx)), x + sx / 2);
      ys.push(y - sy / 2, y + sy / 2);
    }
    if (pose) for (const [x, y] of shape.finger) { const p = place(pose, x, y); xs.push(p[0]); ys.push(p[1]); }
    const want = [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
    // The view is fixed unless something would leave it.
    this.box = this.box ? this.box.map((v, i) => (i < 2 ? Math.min(v, want[i]) : Math.max(v, want[i]))) : want;
    const [x0, y0, x1, y1] = this.box;
    const scale = Math.min((width - 16) / (y1 - y0), (height - 16) / (x1 - x0));
    const at = (x, y) => [width / 2 - (y - (y0 + y1) / 2) * scale, height / 2 - (x - (x0 + x1) / 2) * scale];
    for (const object of reach.objects) this.#thing(pen, object, at, scale, colour);
    this.#target(pen, state, at, scale, colour);
    pen.lineWidth = 2;
    pen.strokeStyle = colour.accent;
    pen.globalAlpha = 0.5;
    pen.beginPath();
    for (const p of this.trail) pen.lineTo(...at(...p));
    pen.stroke();
    pen.globalAlpha = 1;
    if (!pose) return;
    pen.beginPath();
    for (const [x, y] of shape.finger) pen.lineTo(...at(...place(pose, x, y)));
    pen.closePath();
    pen.fillStyle = pen.strokeStyle = colour.finger;
    pen.globalAlpha = 0.3;
    pen.fill();
    pen.globalAlpha = 1;
    pen.lineWidth = 2;
    pen.stroke();
    if (ahead && state) {
      const from = at(...ahead);
      const speed = Math.hypot(state.commanded[0] || 0, state.commanded[1] || 0);
      if (speed > 0.002) {
        const to = at(ahead[0] + state.commanded[0] * 0.9, ahead[1] + state.commanded[1] * 0.9);
        arrow(pen, ...from, ...to, colour.accent, 2.5);
      }
    }
    for (const board of boards) {
      if (!board.valid || !board.force) continue;
      for (const patch of board.force.patches) {
        if (patch.c.some((v) => v === null) || patch.f.some((v) => v === null) || patch.n < 0.05) continue;
        const [x, y] = place(pose, patch.c[0], patch.c[1]);
        const c = Math.cos(pose.heading), s = Math.sin(pose.heading);
        const fx = c * patch.f[0] - s * patch.f[1], fy = s * patch.f[0] + c * patch.f[1];
        const end = at(x, y), long = Math.hypot(fx, fy) * METRES_PER_N;
        const reachOf = Math.min(1, 0.09 / Math.max(long, 1e-6));
        const begin = at(x - fx * METRES_PER_N * reachOf, y - fy * METRES_PER_N * reachOf);
        arrow(pen, ...begin, ...end, colour.shear, 2.5);
      }
    }
  }

  #follow(point, state) {
    const last = this.trail.at(-1);
    if (state && state.state === "reaching" && state.elapsed !== null && state.elapsed < (this.elapsed ?? 0)) this.trail = [];
    this.elapsed = state ? state.elapsed : 0;
    if (!last || Math.hypot(point[0] - last[0], point[1] - last[1]) > 0.0008) this.trail.push(point);
    if (this.trail.length > TRAIL) this.trail.shift();
  }

  #thing(pen, [kind, form, x, y, yaw, sx, sy, tone], at, scale, colour) {
    if (kind === "finger" || kind === "goal") return;
    const [px, py] = at(x, y);
    pen.save();
    pen.translate(px, py);
    pen.rotate(-yaw);
    if (kind === "cupboard") pen.fillStyle = colour.wood;
    else {
      const light = parseFloat(colour.object), dark = parseFloat(colour["object-dark"]);
      pen.fillStyle = `hsl(215 8% ${dark + (light - dark) * Math.max(0, Math.min(1, (tone - 0.25) / 0.6))}%)`;
    }
    pen.beginPath();
    if (form === CYLINDER) pen.arc(0, 0, (sx / 2) * scale, 0, 7);
    else pen.rect((-sy / 2) * scale, (-sx / 2) * scale, sy * scale, sx * scale);
    pen.fill();
    pen.restore();
  }

  #target(pen, state, at, scale, colour) {
    if (!state || state.goal.some((v) => v === null)) return;
    const [x, y] = at(state.goal[0], state.goal[1]);
    const radius = Math.max(state.goal[2] * scale, 5);
    pen.strokeStyle = pen.fillStyle = colour.goal;
    pen.lineWidth = 2;
    pen.beginPath();
    pen.arc(x, y, radius, 0, 7);
    pen.stroke();
    pen.beginPath();
    pen.arc(x, y, 2.5, 0, 7);
    pen.fill();
    pen.lineWidth = 1.5;
    pen.beginPath();
    for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      pen.moveTo(x + dx * (radius + 2), y + dy * (radius + 2));
      pen.lineTo(x + dx * (radius + 7), y + dy * (radius + 7));
    }
    pen.stroke();
  }
}

function place(pose, x, y) {
  const c = Math.cos(pose.heading), s = Math.sin(pose.heading);
  return [pose.x + c * x - s * y, pose.y + s * x + c * y];
}
