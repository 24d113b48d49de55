/* The playground: filters of ManeuveringTarget, as C compiled to WebAssembly, follow the pointer or a file.
   PLAYGROUND_FILTERS, of the script beside this one, holds for each filter the names of its weights and the module in
   base 64. Lengths are in metres and times in seconds, as in the environment. Nothing is fetched. */
"use strict";

const WIDTH = 16000;           // of the map, m
const HASTE = 30;              // seconds of the target in one of the reader
const FASTEST = 300;           // speed at which the target reaches the pointer, m/s
const IN_VIEW = 1000;          // steps that are kept and drawn
const MOST_ROWS = 20000;       // of a file
const GLINT_FACTOR = 5;        // as in the scenario `glint`
const TURN_RATE = 6;           // by the keys, degrees/s
const PIECE = 25;              // points of a line that are drawn at once
const NEWEST = 40;             // steps of a track that are drawn in full colour
const HOW = "Move the pointer over the map, or steer with the arrow keys. Or drop a table (CSV) with time, x, y on it.";
const SETTINGS = {
  noise: { text: "noise", unit: "m", min: 10, max: 500, step: 10, value: 100 },
  missed: { text: "missed scans", unit: "%", min: 0, max: 80, step: 5, value: 10 },
  period: { text: "scan period", unit: "s", min: 1, max: 12, step: 1, value: 6 },
  glint: { text: "glint", unit: "%", min: 0, max: 50, step: 5, value: 0 },
};

/* A filter for one track. Its rows lie in the module's memory: initial holds mean and covariance; measurement scan,
   position, variance, available, interval, elapsed; estimate mean, covariance, log likelihood, NIS and its degrees. */
class Filter {
  static async load(name, { module, weights }) {
    const bytes = Uint8Array.from(atob(module), (letter) => letter.charCodeAt(0));
    return new Filter(name, weights, (await WebAssembly.instantiate(bytes, {})).instance.exports);
  }

  constructor(name, weightNames, exports) {
    Object.assign(this, { name, weightNames, exports, shown: true });
    exports._initialize?.();
    const row = (place, count) => new Float64Array(exports.memory.buffer, place, count);
    this.initial = row(exports.initial(), 20);
    this.measurement = row(exports.measurement(), 8);
    this.estimate = row(exports.estimate(), 23);
    this.weights = row(exports.weights(), weightNames.length);
  }

  start({ mean, covariance }) {
    this.initial.set([...mean, ...covariance.flat()]);
    this.exports.start();
  }

  update(measurement) {
    this.measurement.set(measurement);
    const taken = this.exports.update() <= 1;  // 2: no number would come of it; 3: its interval is negative
    const row = Array.from(this.estimate);
    const covariance = [4, 8, 12, 16].map((first) => row.slice(first, first + 4));
    return { taken, mean: row.slice(0, 4), covariance, nis: row[21], weights: Array.from(this.weights) };
  }
}

/* The start of a track from two plots: the second, and their difference over the time between them. */
function twoPlotStart(before, first) {
  const T = first.time - before.time;
  const covariance = [0, 1, 2, 3].map(() => [0, 0, 0, 0]);
  ["sigma_x", "sigma_y"].forEach((sigma, axis) => {
    const [old, now] = [before[sigma] ** 2, first[sigma] ** 2];
    covariance[axis][axis] = now;
    covariance[axis][axis + 2] = covariance[axis + 2][axis] = now / T;
    covariance[axis + 2][axis + 2] = (old + now) / T ** 2;
  });
  return { mean: [first.x, first.y, (first.x - before.x) / T, (first.y - before.y) / T], covariance };
}

/* Plots of one target, and what the filters make of them. */
class Track {
  constructor(filters, most) {
    Object.assign(this, { filters, most, steps: [], last: null, scan: 0, time: NaN });
  }

  /* plot: time, x, y, sigma_x, sigma_y, truth_x, truth_y; NaN: the scan missed the target, the truth is not known. */
  add(plot) {
    const seen = Number.isFinite(plot.x) && Number.isFinite(plot.y);
    const step = { ...plot, seen, estimates: {} };
    if (this.scan > 0) {
      const variance = [plot.sigma_x ** 2, plot.sigma_y ** 2];
      const clocks = [plot.time - this.time, plot.time - this.last.time];
      const row = [this.scan, ...(seen ? [plot.x, plot.y] : [0, 0]), ...variance, seen ? 1 : 0, ...clocks];
      for (const filter of this.filters) step.estimates[filter.name] = filter.update(row);
      this.scan += 1;
    } else if (seen && this.last) {
      step.start = twoPlotStart(this.last, plot);
      this.filters.forEach((filter) => filter.start(step.start));
      this.scan = 1;
    }
    if (seen) this.last = plot;
    this.time = plot.time;
    this.steps.push(step);
    if (this.steps.length > this.most) this.steps.shift();
  }
}

const normal = () => Math.sqrt(-2 * Math.log(1 - Math.random())) * Math.cos(2 * Math.PI * Math.random());

/* Measurement of a target at a time. */
function measure(target, time, { noise, missed, glint }) {
  const factor = Math.random() < missed / 100 ? NaN : Math.random() < glint / 100 ? GLINT_FACTOR : 1;
  const [x, y] = [target.x, target.y].map((truth) => truth + factor * noise * normal());
  return { time, x, y, sigma_x: noise, sigma_y: noise, truth_x: target.x, truth_y: target.y };
}

/* Moves the target: to the pointer where there is one, else as the keys say, else by itself. */
class Target {
  constructor(height) {
    Object.assign(this, { x: 0.25 * WIDTH, y: 0.3 * height, heading: 60, speed: 80, turn: 0, left: 60 });
    Object.assign(this, { height, pointer: null, keys: new Set() });
  }

  move(seconds) {
    if (this.pointer) return this.approach(seconds);
    if (this.keys.size) this.steer(seconds);
    else this.fly(seconds);
    this.heading += seconds * this.turn;
    const radians = (this.heading * Math.PI) / 180;
    const within = (value, most) => Math.min(Math.max(value, 0), most);
    this.x = within(this.x + seconds * this.speed * Math.sin(radians), WIDTH);
    this.y = within(this.y + seconds * this.speed * Math.cos(radians), this.height);
  }

  approach(seconds) {
    const [east, north] = [this.pointer.x - this.x, this.pointer.y - this.y];
    const distance = Math.hypot(east, north);
    const share = Math.min(1, (FASTEST * seconds) / Math.max(distance, 1e-9));
    this.x += share * east;
    this.y += share * north;
    if (distance > 0) this.heading = (Math.atan2(east, north) * 180) / Math.PI;
  }

  steer(seconds) {
    const [up, down, right, left] = ["Up", "Down", "Right", "Left"].map((key) => this.keys.has(`Arrow${key}`));
    this.speed = Math.min(Math.max(this.speed + 10 * seconds * (up - down), 30), FASTEST);
    [this.turn, this.left] = [TURN_RATE * (right - left), 60];
  }

  /* Straight flight and turns in random order; towards the middle near the border, by 5.6 m/s^2. */
  fly(seconds) {
    this.left -= seconds;
    const [east, north] = [WIDTH / 2 - this.x, this.height / 2 - this.y];
    if (Math.abs(east) > 0.36 * WIDTH || Math.abs(north) > 0.22 * this.height) {
      // On a wide map the middle is mostly to the side: the course to it counts the sides as if the map were a square.
      const off = (Math.atan2((east * this.height) / WIDTH, north) * 180) / Math.PI - this.heading;
      const nearer = off - 360 * Math.round(off / 360);
      if (Math.abs(nearer) > 30) [this.turn, this.left] = [Math.sign(nearer) * 4, 15];
    } else if (this.left <= 0) {
      [this.turn, this.left] = this.turn ? [0, 40 + 60 * Math.random()] : [Math.random() < 0.5 ? 3 : -3, 30];
    }
  }
}

/* Plots of a table. Its first line names time, x, y; optional sigma_x, sigma_y, truth_position_x, truth_position_y. */
function readTable(text, noise) {
  const lines = text.split(/\r?\n/).filter((line) => line.trim() !== "");
  const names = lines[0].split(",").map((name) => name.trim());
  const missing = ["time", "x", "y"].filter((name) => !names.includes(name));
  if (missing.length) throw Error(`the first line must name time, x and y; ${missing.join(", ")} not found`);
  if (lines.length - 1 > MOST_ROWS) throw Error(`${lines.length - 1} rows; at most ${MOST_ROWS} are run here`);
  const plots = lines.slice(1).map((line) => {
    const cells = line.split(",");
    const read = (name) => Number(cells[names.indexOf(name)]?.trim() || NaN);
    const [sigma_x, sigma_y] = [read("sigma_x"), read("sigma_y")].map((sigma) => (sigma > 0 ? sigma : noise));
    const truth = { truth_x: read("truth_position_x"), truth_y: read("truth_position_y") };
    return { time: read("time"), x: read("x"), y: read("y"), sigma_x, sigma_y, ...truth };
  });
  const place = plots.findIndex((plot, i) => !(plot.time > (i > 0 ? plots[i - 1].time : -Infinity)));
  if (place >= 0) throw Error(`the time of row ${place + 1} is no number, or is not above the one before`);
  if (plots.filter((plot) => Number.isFinite(plot.x + plot.y)).length < 3) throw Error("three plots are needed");
  return plots;
}

/* A canvas as sharp as the screen, with the page's colours. */
class View {
  constructor(canvas) {
    Object.assign(this, { canvas, context: canvas.getContext("2d"), colours: {} });
  }

  begin() {
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight];
    const size = { width: Math.round(width * ratio), height: Math.round(height * ratio) };
    if (this.canvas.width !== size.width || this.canvas.height !== size.height) Object.assign(this.canvas, size);
    this.context.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.context.clearRect(0, 0, width, height);
    Object.assign(this.context, { font: "12px system-ui, sans-serif", lineJoin: "bevel", lineCap: "round" });
    return [width, height];
  }

  colour(name) {
    return (this.colours[name] ??= getComputedStyle(this.canvas).getPropertyValue(`--${name}`).trim());
  }

  /* points: [x, y] or null for a gap. In pieces: the time that a long line takes grows faster than its length. */
  line(points, colour, { width = 1.5, alpha = 1 } = {}) {
    const { context } = this;
    Object.assign(context, { strokeStyle: colour, lineWidth: width, globalAlpha: alpha });
    for (let first = 0; first < points.length; first += PIECE) {
      context.beginPath();
      for (let i = first; i < Math.min(first + PIECE + 1, points.length); i += 1) {
        if (points[i]) context[i > first && points[i - 1] ? "lineTo" : "moveTo"](...points[i]);
      }
      context.stroke();
    }
    context.globalAlpha = 1;
  }

  text(words, x, y, align = "left") {
    Object.assign(this.context, { fillStyle: this.colour("text"), textAlign: align });
    this.context.fillText(words, x, y);
  }
}

/* Two sigma of the position, as a closed line about the mean: a, b and c are the covariance's Cholesky factor. */
function ellipse({ mean, covariance: P }, toPixel) {
  const a = Math.sqrt(P[0][0]);
  const b = P[0][1] / a;
  const c = Math.sqrt(Math.max(P[1][1] - b * b, 0));
  return Array.from({ length: 49 }, (_, i) => {
    const [u, v] = [2 * Math.cos((i * Math.PI) / 24), 2 * Math.sin((i * Math.PI) / 24)];
    return toPixel(mean[0] + a * u, mean[1] + b * u + c * v);
  });
}

/* From metres to pixels of a view, with one scale for both axes. */
function scaleOf([width, height], region) {
  const scale = Math.min(width / region.width, height / region.height);
  const [left, low] = [(width - scale * region.width) / 2, (height - scale * region.height) / 2];
  return { scale, toPixel: (x, y) => [left + scale * (x - region.x), height - low - scale * (y - region.y)] };
}

function drawMap(view, steps, filters, region) {
  const size = view.begin();
  const { scale, toPixel } = scaleOf(size, region);
  view.context.fillStyle = view.colour("plot");
  for (const [x, y] of steps.filter(({ seen }) => seen).map((step) => toPixel(step.x, step.y))) {
    view.context.fillRect(x - 1.5, y - 1.5, 3, 3);
  }
  const truth = steps.map((s) => (Number.isFinite(s.truth_x) ? toPixel(s.truth_x, s.truth_y) : null));
  view.line(truth, view.colour("text"), { alpha: 0.5 });
  for (const filter of filters) {
    const colour = view.colour(filter.name);
    const estimates = steps.map((step) => step.estimates[filter.name]);
    const points = estimates.map((own) => (own?.taken ? toPixel(own.mean[0], own.mean[1]) : null));
    const split = Math.max(points.length - NEWEST, 0);
    view.line(points.slice(0, split + 1), colour, { width: 1, alpha: 0.3 });
    view.line(points.slice(split), colour);
    if (estimates.at(-1)?.taken) view.line(ellipse(estimates.at(-1), toPixel), colour, { width: 2 });
  }
  const length = 10 ** Math.floor(Math.log10(region.width / 4));
  view.line([[12, size[1] - 12], [12 + scale * length, size[1] - 12]], view.colour("text"), { width: 2 });
  view.text(length >= 1000 ? `${length / 1000} km` : `${length} m`, 12, size[1] - 18);
}

/* Distance to the truth, m; where that is not known, the innovation in sigma of a coordinate. */
function errorOf(step, name, known) {
  const estimate = step.estimates[name];
  if (!estimate?.taken) return NaN;
  if (known) return Math.hypot(estimate.mean[0] - step.truth_x, estimate.mean[1] - step.truth_y);
  return step.seen ? Math.sqrt(Math.max(estimate.nis, 0) / 2) : NaN;
}

/* Whether the truth lies outside the ellipse; null where it is unknown. */
function isOutside({ estimates, truth_x, truth_y }, name) {
  if (!estimates[name]?.taken || !Number.isFinite(truth_x)) return null;
  const { mean, covariance: [[a, b], [, c]] } = estimates[name];
  const [x, y] = [mean[0] - truth_x, mean[1] - truth_y];
  return c * x * x - 2 * b * x * y + a * y * y > 4 * (a * c - b * b);
}

function drawErrors(view, steps, filters, known) {
  const [width, height] = view.begin();
  const [left, top, bottom] = [44, 20, height - 6];
  const errors = filters.map((filter) => steps.map((step) => errorOf(step, filter.name, known)));
  const low = known ? 10 : 0.1;
  const high = errors.flat().reduce((most, error) => (error > most ? error : most), 10 * low);
  const toY = (e) => bottom - ((bottom - top) * Math.log(Math.max(e, low) / low)) / Math.log(high / low);
  const toX = (i) => left + ((width - left - 4) * i) / Math.max(steps.length - 1, 100);
  for (let tick = low; tick <= high * 1.001; tick *= 10) {
    view.line([[left, toY(tick)], [width, toY(tick)]], view.colour("text"), { width: 1, alpha: 0.2 });
    view.text(tick.toPrecision(1) * 1, left - 6, toY(tick) + 4, "right");
  }
  filters.forEach((filter, place) => {
    const points = errors[place].map((error, i) => (Number.isFinite(error) ? [toX(i), toY(error)] : null));
    view.line(points, view.colour(filter.name), { width: 1 });
  });
  view.text(known ? "error of position, m" : "innovation, sigma", left, 12);
}

/* Weights of one filter's hypotheses, one above the other; they sum to one. A gain stands alone. */
function drawWeights(view, steps, filter) {
  const [width, height] = view.begin();
  const [top, bottom] = [18, height - 2];
  const toX = (i) => Math.round((width * i) / Math.max(steps.length, 100));
  const heights = steps.map(() => 0);
  filter.weightNames.forEach((_, hypothesis) => {
    Object.assign(view.context, { fillStyle: view.colour(filter.name), globalAlpha: [0.25, 0.55, 0.9][hypothesis] });
    steps.forEach((step, i) => {
      const own = (step.estimates[filter.name]?.weights[hypothesis] ?? 0) * (bottom - top);
      heights[i] += own;
      view.context.fillRect(toX(i), bottom - heights[i], toX(i + 1) - toX(i), own);
    });
  });
  view.context.globalAlpha = 1;
  view.line([[0, top], [width, top]], view.colour("text"), { width: 1, alpha: 0.2 });
  view.text(`${filter.name}, from below: ${filter.weightNames.join(", ")}`, 0, 12);
}

function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

class Playground {
  constructor(root, filters) {
    Object.assign(this, { root, filters, paused: matchMedia("(prefers-reduced-motion: reduce)").matches });
    this.settings = Object.fromEntries(Object.entries(SETTINGS).map(([name, { value }]) => [name, value]));
    this.build();
    this.views = [this.layer, this.map, this.errors, ...this.weights].map((canvas) => new View(canvas));
    const [above, map, errors, ...weights] = this.views;
    this.parts = [
      (steps, shown) => drawMap(map, steps, shown, this.region(steps)),
      (steps, shown, known) => drawErrors(errors, steps, shown, known),
      ...weights.map((view, i) => (steps) => drawWeights(view, steps, this.filters[i])),
      (steps, shown, known) => this.tabulate(steps, known),
    ];
    Object.assign(this, { above, waiting: new Set() });
    this.restart();
    this.listen();
    root.dataset.state = "ready";
    requestAnimationFrame((now) => this.frame(now, now));
  }

  build() {
    const ariaLabel = "Map of a target and four filters. Arrow keys steer the target, space pauses.";
    const canvas = (className, more = {}) => element("canvas", { className, ...more });
    this.map = canvas("map", { tabIndex: 0, role: "img", ariaLabel });
    [this.layer, this.errors] = [canvas("map layer"), canvas("errors")];
    this.weights = this.filters.map(() => canvas("weights"));
    const button = (words) => element("button", { type: "button", textContent: words });
    [this.pause, this.again] = [button(this.paused ? "Go on" : "Pause"), button("Start again")];
    this.file = element("input", { type: "file", accept: ".csv,text/csv" });
    this.end = element("input", { type: "range", min: 1 });
    this.endLabel = element("label", { hidden: true }, "until row ", this.end);
    this.status = element("p", { role: "status" });
    const sliders = Object.entries(SETTINGS).map(([name, { text, unit, ...range }]) => {
      const input = element("input", { type: "range", name, ...range });
      const output = element("output", { textContent: `${range.value} ${unit}` });
      input.addEventListener("input", () => {
        output.textContent = `${input.value} ${unit}`;
        this.settings[name] = Number(input.value);
        if (this.text !== null && name === "noise") this.run();
      });
      return element("label", {}, element("span", { textContent: text }), input, output);
    });
    this.cells = this.filters.map(() => [element("td"), element("td"), element("td")]);
    const rows = this.filters.map((filter, i) => {
      const box = element("input", { type: "checkbox", checked: true });
      box.addEventListener("change", () => ([filter.shown, this.stale] = [box.checked, true]));
      const sample = element("i", { style: `background: var(--${filter.name})` });
      const name = element("th", { scope: "row" }, element("label", {}, box, sample, ` ${filter.name}`));
      return element("tr", {}, name, ...this.cells[i]);
    });
    this.heads = ["filter", "error", "RMSE", "outside"].map((words) => element("th", { textContent: words }));
    const table = element("table", {}, element("tr", {}, ...this.heads), ...rows);
    const part = (className, ...children) => element("div", { className }, ...children);
    const file = element("label", {}, "your file ", this.file);
    const controls = part("controls", this.pause, this.again, file, this.endLabel);
    const middle = part("columns", table, part("sliders", ...sliders));
    const weights = part("columns", ...this.weights);
    this.root.append(this.map, this.layer, controls, this.status, middle, this.errors, weights);
  }

  listen() {
    const { map, root } = this;
    map.onpointermove = map.onpointerdown = (event) => {
      const box = map.getBoundingClientRect();
      const [x, y] = [(event.clientX - box.left) / box.width, (box.bottom - event.clientY) / box.height];
      this.target.pointer = { x: x * WIDTH, y: y * this.target.height };
    };
    map.onpointerleave = map.onpointercancel = () => (this.target.pointer = null);
    map.addEventListener("keydown", (event) => {
      if (event.key === " ") this.togglePause();
      else if (event.key.startsWith("Arrow")) this.target.keys.add(event.key);
      else return;
      event.preventDefault();
    });
    map.addEventListener("keyup", (event) => this.target.keys.delete(event.key));
    map.addEventListener("blur", () => this.target.keys.clear());
    this.pause.addEventListener("click", () => this.togglePause());
    this.again.addEventListener("click", () => this.restart());
    this.file.addEventListener("change", () => this.open(this.file.files[0]));
    this.end.addEventListener("input", () => (this.stale = true));
    root.addEventListener("dragover", (event) => event.preventDefault());
    root.addEventListener("drop", (event) => {
      event.preventDefault();
      this.open(event.dataTransfer.files[0]);
    });
    const changed = () => {
      this.views.forEach((view) => (view.colours = {}));
      [this.target.height, this.stale] = [this.height(), true];
    };
    new MutationObserver(changed).observe(document.documentElement, { attributes: true });
    new ResizeObserver(changed).observe(root);
    new IntersectionObserver(([entry]) => (this.visible = entry.isIntersecting)).observe(root);
  }

  togglePause() {
    this.paused = !this.paused;
    this.pause.textContent = this.paused ? "Go on" : "Pause";
  }

  height() {
    return (WIDTH * this.map.clientHeight) / this.map.clientWidth;
  }

  restart() {
    this.target = new Target(this.height());
    Object.assign(this, { track: new Track(this.filters, IN_VIEW), time: 0, next: 0, text: null, stale: true });
    this.status.textContent = HOW;
    this.endLabel.hidden = true;
  }

  async open(file) {
    if (!file) return;
    [this.text, this.name] = [await file.text(), file.name];
    this.run();
  }

  run() {
    try {
      const plots = readTable(this.text, this.settings.noise);
      this.track = new Track(this.filters, MOST_ROWS);
      plots.forEach((plot) => this.track.add(plot));
      this.endLabel.hidden = plots.length <= IN_VIEW;
      [this.end.max, this.end.value, this.stale] = [plots.length, plots.length, true];
      this.status.textContent = `${this.name}: ${plots.length} rows. Filters expect metres, seconds and aircraft.`;
    } catch (error) {
      this.restart();
      this.status.textContent = `The file cannot be run: ${error.message}`;
    }
  }

  /* The target moves in every frame. What depends on the steps is drawn one part a frame: a thousand take long. */
  frame(before, now) {
    requestAnimationFrame((later) => this.frame(now, later));
    if (!this.visible) return;
    const live = this.text === null;
    if (live && !this.paused) this.advance(Math.min((now - before) / 1000, 0.1) * HASTE);
    if (this.stale) this.parts.forEach((part) => this.waiting.add(part));
    this.stale = false;
    const [part] = this.waiting;
    this.waiting.delete(part);
    const steps = live ? this.track.steps : this.track.steps.slice(0, this.end.value).slice(-IN_VIEW);
    part?.(steps, this.filters.filter((filter) => filter.shown), steps.some((step) => Number.isFinite(step.truth_x)));
    const { toPixel } = scaleOf(this.above.begin(), this.region(steps));
    const target = Array(2).fill(toPixel(this.target.x, this.target.y));
    if (live) this.above.line(target, this.above.colour("text"), { width: 9 });
  }

  /* Let the target move, a second at most at a time, so that it turns back before the border however slow the page is;
     whenever a scan is due, the filters get its measurement. */
  advance(seconds) {
    const end = this.time + seconds;
    while (this.time < end) {
      const time = Math.min(this.time + 1, this.next, end);
      this.target.move(time - this.time);
      this.time = time;
      if (time < this.next) continue;
      this.track.add(measure(this.target, time, this.settings));
      this.next += this.settings.period;
      this.stale = true;
    }
  }

  region(steps) {
    if (this.text === null) return { x: 0, y: 0, width: WIDTH, height: this.target.height };
    const seen = steps.filter((step) => step.seen);
    const range = (values) => [Math.min(...values), Math.max(...values)];
    const [[x, right], [y, top]] = [range(seen.map((step) => step.x)), range(seen.map((step) => step.y))];
    const margin = 0.05 * Math.max(right - x, top - y, 1);
    return { x: x - margin, y: y - margin, width: right - x + 2 * margin, height: top - y + 2 * margin };
  }

  tabulate(steps, known) {
    [this.heads[1].textContent, this.heads[2].textContent] = known ? ["error", "RMSE"] : ["innovation", "RMS"];
    this.filters.forEach((filter, i) => {
      const errors = steps.map((step) => errorOf(step, filter.name, known)).filter(Number.isFinite);
      const rmse = Math.sqrt(errors.reduce((sum, error) => sum + error ** 2, 0) / errors.length);
      const number = (e) => (!Number.isFinite(e) ? "" : known ? `${e.toFixed(0)} m` : `${e.toFixed(2)} sigma`);
      const beyond = steps.map((step) => isOutside(step, filter.name)).filter((is) => is !== null);
      const share = beyond.length ? `${((100 * beyond.filter(Boolean).length) / beyond.length).toFixed(0)} %` : "";
      [number(errors.at(-1)), number(rmse), share].forEach((words, j) => (this.cells[i][j].textContent = words));
    });
  }
}

Promise.all(Object.entries(PLAYGROUND_FILTERS).map(([name, own]) => Filter.load(name, own))).then((filters) => {
  window.playground = new Playground(document.getElementById("playground"), filters);
});
