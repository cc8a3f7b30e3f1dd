// Six sliders on the codec's levels. A slider that was not moved keeps its exact value.
const THUMB_PX = 16;

const make = (tag, name, parent, text) => {
  const made = document.createElement(tag);
  made.className = name;
  if (text !== undefined) made.textContent = text;
  parent.append(made);
  return made;
};

export const number = (value) => String(+value.toPrecision(3));

// Where a share 0..1 lies on the track: the thumb's middle runs half a thumb inside both ends.
const place = (share) => `calc(${THUMB_PX / 2}px + (100% - ${THUMB_PX}px) * ${share.toFixed(4)})`;
const span = (low, high) => `calc((100% - ${THUMB_PX}px) * ${(high - low).toFixed(4)})`;

const nearest = (stops, value) => {
  let best = 0;
  stops.forEach((stop, i) => { if (Math.abs(stop - value) < Math.abs(stops[best] - value)) best = i; });
  return best;
};

// "K_p" -> K with a subscript p.
export const symbol = (name, parent) => {
  const [letter, index] = name.split("_");
  const holder = make("b", "symbol", parent, letter);
  make("sub", "", holder, index);
};

class Slider {
  constructor(about, parent, onMove) {
    this.about = about;
    const row = make("label", "slider", parent);
    const name = make("span", "slider-name", row);
    symbol(about.name, name);
    make("small", "", name, about.about);
    const track = make("span", "track", row);
    make("i", "rail", track);
    this.outer = make("i", "band outer", track);
    this.inner = make("i", "band inner", track);
    this.forbidden = make("i", "forbidden", track);
    this.mark = make("i", "mark", track);
    this.input = make("input", "", track);
    Object.assign(this.input, { type: "range", min: 0, max: about.stops.length - 1, step: 1 });
    this.input.id = `slider-${about.name}`;
    this.input.setAttribute("aria-label", `${about.name}, ${about.about}`);
    const value = make("span", "slider-value", row);
    this.now = make("output", "", value);
    this.was = make("small", "", value);
    this.input.addEventListener("input", () => {
      const level = +this.input.value;
      // Back at the level where it stood, it has the exact value again.
      this.value = level === nearest(about.stops, this.start) ? this.start : about.stops[level];
      this.write();
      onMove();
    });
  }

  // proposed: marked on the track; start: where the slider stands when nobody has moved it.
  set(proposed, start, value, style) {
    Object.assign(this, { proposed, start, value });
    this.input.value = nearest(this.about.stops, value);
    this.mark.style.left = place(nearest(this.about.stops, proposed) / (this.about.stops.length - 1));
    const [least, low, high, most] = this.about.bands[style];
    for (const [band, from, to] of [[this.outer, least, most], [this.inner, low, high]]) {
      band.style.left = place(from);
      band.style.width = span(from, to);
    }
    this.write();
  }

  forbidAbove(limit) {
    const { stops } = this.about;
    const share = nearest(stops, limit) / (stops.length - 1);
    this.forbidden.hidden = limit >= stops.at(-1);
    this.forbidden.style.left = place(share);
    this.forbidden.style.width = span(share, 1);
  }

  write() {
    const unit = this.about.unit ? ` ${this.about.unit}` : "";
    this.now.textContent = number(this.value) + unit;
    this.was.textContent = `proposed ${number(this.proposed)}`;
    this.input.setAttribute("aria-valuetext", `${number(this.value)}${unit}, proposed ${number(this.proposed)}`);
    this.now.classList.toggle("changed", this.value !== this.proposed);
  }
}

export class Sliders {
  constructor(parent, abouts, onMove) {
    this.sliders = abouts.map((about) => new Slider(about, parent, onMove));
  }

  get values() { return this.sliders.map((slider) => slider.value); }

  set(proposed, start, values, style) {
    this.sliders.forEach((slider, i) => slider.set(proposed[i], start[i], values[i], style));
  }

  // Of K_i, at the K_p on the sliders.
  forbidAbove(limit) {
    this.sliders.forEach((slider, i) => { if (i !== 1) slider.forbidden.hidden = true; });
    this.sliders[1].forbidAbove(limit);
  }
}
