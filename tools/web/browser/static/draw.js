// Plots of the last seconds, and the floor from above.

export const COLOURS = ["#3367d6", "#e8710a", "#1e8e3e", "#a142f4", "#c5221f", "#00838f"];

export const DOTS = [2, 3], DASHES = [7, 4];

export class Plot {
  constructor(canvas) { this.canvas = canvas; }

  // Draws `series`: get(frame) is a number or null; what was not measured is a gap.
  draw(frames, span, series) {
    const { canvas } = this, scale = devicePixelRatio || 1;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    if (canvas.width !== width * scale) { canvas.width = width * scale; canvas.height = height * scale; }
    const pen = canvas.getContext("2d");
    pen.setTransform(scale, 0, 0, scale, 0, 0);
    pen.clearRect(0, 0, width, height);
    if (!frames.length) return;
    const end = frames.at(-1).time, values = frames.flatMap((f) => series.map((s) => s.get(f))).filter((v) => v !== null);
    if (!values.length) return;
    let low = Math.min(...values), high = Math.max(...values);
    if (high - low < 1e-3) { low -= 0.5e-3; high += 0.5e-3; }
    const x = (t) => 34 + ((t - end + span) / span) * (width - 38), y = (v) => height - 6 - ((v - low) / (high - low)) * (height - 12);
    pen.font = "10px system-ui";
    pen.fillStyle = "#5d6675";
    const digits = Math.max(0, 2 - Math.floor(Math.log10(high - low)));
    [low, (low + high) / 2, high].forEach((v) => {
      pen.fillText(v.toFixed(Math.min(digits, 4)), 0, y(v) + 3);
      pen.strokeStyle = "#eceef2";
      line(pen, [[34, y(v)], [width, y(v)]]);
    });
    for (const { get, colour, dash } of series) {
      pen.strokeStyle = colour;
      pen.setLineDash(dash ?? []);
      pen.beginPath();
      let down = false;
      for (const frame of frames) {
        const value = get(frame);
        if (value === null) { down = false; continue; }
        down ? pen.lineTo(x(frame.time), y(value)) : pen.moveTo(x(frame.time), y(value));
        down = true;
      }
      pen.stroke();
    }
    pen.setLineDash([]);
  }
}

function line(pen, points) {
  pen.beginPath();
  points.forEach(([px, py], i) => (i ? pen.lineTo(px, py) : pen.moveTo(px, py)));
  pen.stroke();
}

// Draws the floor: x of the odometry frame up, y to the left. Returns what tells the place [m] of a pixel.
export function drawMap(canvas, frame, run) {
  const pen = canvas.getContext("2d"), size = canvas.width;
  pen.clearRect(0, 0, size, size);
  if (!frame.place) return null;
  const [px, py, , yaw] = frame.place, goal = frame.goal;
  let reach = 1.5;
  if (goal) reach = Math.min(8, Math.max(reach, 1.15 * Math.max(Math.abs(goal[0] - px), Math.abs(goal[1] - py))));
  const scale = size / 2 / reach;
  const at = ([x, y]) => [size / 2 - (y - py) * scale, size / 2 - (x - px) * scale];
  pen.strokeStyle = "#eceef2";
  for (let m = -10; m <= 10; m += 0.5) {
    const gx = Math.round(px * 2) / 2 + m, gy = Math.round(py * 2) / 2 + m;
    line(pen, [at([gx, py - 9]), at([gx, py + 9])]);
    line(pen, [at([px - 9, gy]), at([px + 9, gy])]);
  }
  const disc = (place, radius, colour) => {
    pen.fillStyle = colour;
    pen.beginPath();
    pen.arc(...at(place), Math.max(radius * scale, 2), 0, 2 * Math.PI);
    pen.fill();
  };
  (frame.obstacles ?? []).forEach(([x, y, radius]) => disc([x, y], radius, "#8c6b52"));
  (frame.robots ?? []).forEach(([x, y]) => disc([x, y], 0.1, "#c5221f"));
  const way = (points, colour) => { if (points) { pen.strokeStyle = colour; pen.lineWidth = 2; line(pen, points.map(at)); pen.lineWidth = 1; } };
  way(run?.path, "#26804d");
  way(frame.path, "#26804d");
  way(frame.plan, "#f28c19");
  way(frame.became, "#3359d9");
  if (frame.other?.place) disc(frame.other.place, 0.06, "#e1821e");
  if (goal) { disc(goal, run?.reach ?? 0.05, "rgba(38,166,77,0.35)"); disc(goal, 0.02, "#26a64d"); }
  const [cx, cy] = at([px, py]);
  pen.save();
  pen.translate(cx, cy);
  pen.rotate(-yaw);
  pen.fillStyle = "#1f2530";
  pen.beginPath();
  pen.moveTo(0, -0.14 * scale); pen.lineTo(0.09 * scale, 0.07 * scale); pen.lineTo(-0.09 * scale, 0.07 * scale);
  pen.fill();
  pen.restore();
  pen.fillStyle = "#5d6675";
  pen.font = "11px system-ui";
  pen.fillText(`${(2 * reach).toFixed(1)} m across`, 6, size - 6);
  const px2m = (pixel) => (size / 2 - pixel) / scale;
  return { place: (x, y) => [px + px2m(y * (size / canvas.clientHeight)), py + px2m(x * (size / canvas.clientWidth))].map((v) => Math.round(v * 1000) / 1000) };
}
