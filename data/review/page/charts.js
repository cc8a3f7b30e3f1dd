// Small line charts over time: what the car would do, proposed (dashed) against edited (solid).
const WIDTH = 300, HEIGHT = 128, LEFT = 38, RIGHT = 8, TOP = 8, BOTTOM = 20;
const SVG = "http://www.w3.org/2000/svg";

const node = (name, attributes, parent, text) => {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  parent?.append(made);
  return made;
};

const say = (value) => String(+value.toPrecision(3)).replace("-", "\u2212");

// Three to five round numbers within [low, high].
const ticks = (low, high) => {
  const rough = (high - low) / 3;
  const power = 10 ** Math.floor(Math.log10(rough));
  const near = [1, 2, 2.5, 5, 10].map((m) => m * power);
  const step = near.reduce((a, b) => (Math.abs(b - rough) < Math.abs(a - rough) ? b : a));
  const found = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + 1e-9 * step; i++) found.push(i * step);
  return found;
};

const path = (times, values, x, y) => {
  let pen = "M", text = "";
  values.forEach((value, i) => {
    if (value === null) { pen = "M"; return; }
    text += `${pen}${x(times[i]).toFixed(1)} ${y(value).toFixed(1)}`;
    pen = "L";
  });
  return text;
};

const summary = (values) => {
  const known = values.filter((value) => value !== null);
  return `${say(Math.min(...known))} to ${say(Math.max(...known))}`;
};

class Chart {
  constructor(parent) {
    const holder = document.createElement("div");
    holder.className = "chart-card";
    this.title = document.createElement("h4");
    this.svg = node("svg", { class: "chart", viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img" });
    holder.append(this.title, this.svg);
    parent.append(holder);
    this.limits = null;
  }

  // A new pair has axes of its own; while its sliders move they only grow, so lines can be compared.
  fit(series, least) {
    const known = series.flat().filter((value) => value !== null);
    let [low, high] = this.limits ?? [0, 0];
    low = Math.min(low, ...known); high = Math.max(high, ...known);
    const missing = least - (high - low);
    if (missing > 0) { high += missing / 2; low -= low < 0 ? missing / 2 : 0; }
    this.limits = [low, high];
  }

  draw(times, proposed, edited) {
    this.fit([proposed.values, edited.values], edited.least);
    const air = 0.04 * (this.limits[1] - this.limits[0]);
    const low = this.limits[0] - (this.limits[0] < 0 ? air : 0), high = this.limits[1] + air;
    const end = times.at(-1);
    const x = (t) => LEFT + (t / end) * (WIDTH - LEFT - RIGHT);
    const y = (v) => TOP + ((high - v) / (high - low)) * (HEIGHT - TOP - BOTTOM);
    this.title.replaceChildren(edited.name);
    const unit = document.createElement("small");
    unit.textContent = ` [${edited.unit}]`;
    this.title.append(unit);
    this.svg.replaceChildren();
    this.svg.setAttribute("aria-label",
      `${edited.name} in ${edited.unit}: proposed ${summary(proposed.values)}, on the sliders ${summary(edited.values)}`);
    for (const tick of ticks(low, high)) {
      node("line", { class: "grid", x1: LEFT, x2: WIDTH - RIGHT, y1: y(tick), y2: y(tick) }, this.svg);
      node("text", { x: LEFT - 5, y: y(tick) + 3.5, "text-anchor": "end" }, this.svg, say(tick));
    }
    for (const tick of ticks(0, end)) {
      const text = tick > 0 ? say(tick) : "0 s";
      node("text", { x: x(tick), y: HEIGHT - 6, "text-anchor": "middle" }, this.svg, text);
    }
    node("path", { class: "line proposed", d: path(times, proposed.values, x, y) }, this.svg);
    node("path", { class: "line edited", d: path(times, edited.values, x, y) }, this.svg);
  }
}

// The charts of all drives; `show` takes two answers of /api/preview.
export class Charts {
  constructor(parent) {
    this.parent = parent;
    this.drives = null;
  }

  reset() {
    this.drives?.forEach((drive) => drive.charts.forEach((chart) => { chart.limits = null; }));
  }

  build(drives) {
    this.parent.replaceChildren();
    this.drives = drives.map((drive) => {
      const column = document.createElement("div");
      const name = document.createElement("h3"), fault = document.createElement("p");
      name.textContent = drive.name;
      name.title = drive.about;
      fault.className = "fault";
      column.append(name, fault);
      this.parent.append(column);
      return { fault, charts: drive.charts.map(() => new Chart(column)) };
    });
  }

  show(proposed, edited) {
    if (this.drives === null) this.build(edited.drives);
    edited.drives.forEach((drive, i) => {
      const mine = this.drives[i];
      mine.fault.hidden = drive.fault === null;
      mine.fault.textContent = drive.fault === null ? "" : `The car ${drive.fault}.`;
      drive.charts.forEach((chart, j) =>
        mine.charts[j].draw(drive.time_s, proposed.drives[i].charts[j], chart));
    });
  }
}
