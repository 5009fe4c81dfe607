// Explorer of thermal videos in a notebook: pictures on canvas, linked in time, zoom and cursor.
// Frames and curves come from Python as binary messages. One question is in flight at a time; of
// those that wait, the latest of each kind is asked next. Nothing is loaded from a network.

const ZERO_CELSIUS = 273.15;
const DIGITS = { "": 3, count: 0 };
const TOOLS = { move: "Move", rectangle: "Rectangle", ellipse: "Ellipse", polygon: "Polygon", line: "Profile" };
const PALETTES = { gnuplot2: "iron", turbo: "rainbow" }; // as other programs call them
const PIXELS = { unflagged: "flagged: hatched", hidden: "flagged: hidden", measured: "measured only", all: "all pixels count" };
const HIDDEN = { unflagged: [0, 0, 0], all: [0, 0, 0], hidden: [0, 0, 1], measured: [0, 1, 1] }; // good, completed, flagged
const FILES = { ".csv": "curves of the regions", ".png": "these pictures", ".tiff": "frame of the chosen picture, 32-bit float", ".nc": "frames and curves", ".gif": "film of these pictures" };
const HELP = "Arrow keys: frame, with shift ten. Space: play. M: mark this time. R: all films less this frame, and back. Title: choose what is plotted. Wheel on a clicked "
  + "picture: zoom; double click: all of it, or the end of a polygon. Delete: remove the region last clicked or drawn. Ctrl+Z: undo. "
  + "Hatched: flagged; dotted: completed, not measured. Triangles: hottest and coldest measured pixel.";

function make(parent, tag, className = "", properties = {}) {
  const element = Object.assign(document.createElement(tag), properties);
  element.className = className;
  parent?.appendChild(element);
  return element;
}
const surface = (width, height) => make(null, "canvas", "", { width, height }).getContext("2d");
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
const rounded = (value) => Math.round(100 * value) / 100; // [pixel]
const capital = (text) => text[0].toUpperCase() + text.slice(1);

class Link {
  constructor(model, take) {
    Object.assign(this, { model, take, page: Math.random().toString(36).slice(2), wanted: new Map(), busy: false });
    this.listener = (message, buffers) => this.receive(message, buffers);
    model.on("msg:custom", this.listener);
  }
  ask(kind, content = {}) { this.wanted.set(kind, content); this.pump(); }
  pump() {
    if (this.busy || !this.wanted.size) return;
    const [kind, content] = this.wanted.entries().next().value;
    this.wanted.delete(kind);
    this.busy = true;
    this.model.send({ kind, page: this.page, ...content });
  }
  receive(message, buffers) {
    if (message.page !== this.page) return;
    this.busy = Boolean(message.progress);
    this.take(message.error ? "error" : message.progress ? "progress" : message.kind, message, buffers);
    this.pump();
  }
}

function isotherm(sides, width, place) {
  // Edges between pixels of which one is above the level (2) and the other one is not (1); 0 without a value.
  const path = new Path2D();
  sides.forEach((side, at) => {
    const [row, column] = [Math.floor(at / width), at % width];
    for (const [next, from] of [[at + 1, [column + 1, row]], [at + width, [column, row + 1]]]) {
      if (!side || !sides[next] || side === sides[next] || (next === at + 1 && column + 1 === width)) continue;
      path.moveTo(...place(...from));
      path.lineTo(...place(column + 1, row + 1));
    }
  });
  return path;
}

function ticks(low, high, count) {
  if (!(high > low)) return [[low, low.toFixed(2)]];
  const power = 10 ** Math.floor(Math.log10((high - low) / count));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((one) => one >= (high - low) / count);
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  const first = Math.ceil(low / step - 1e-9);
  return Array.from({ length: Math.floor(high / step + 1e-9) - first + 1 }, (_, i) => [(first + i) * step, ((first + i) * step).toFixed(digits)]);
}

const interval = ({ mean, std }, i) => [-1.96, 1.96].map((factor) => mean(i) + factor * std(i)); // of 95 %

function stroke(context, path, ...lines) {
  for (const [strokeStyle, width] of lines) {
    Object.assign(context, { strokeStyle, lineWidth: width * devicePixelRatio });
    context.stroke(path);
  }
}

function outline({ kind, points }, place = (column, row) => [column, row]) {
  const path = new Path2D();
  const corners = points.map(([row, column]) => place(column, row));
  const [[left, top], [right, bottom]] = [corners[0], corners[1] ?? corners[0]];
  if (kind === "rectangle") path.rect(left, top, right - left, bottom - top);
  else if (kind === "ellipse") path.ellipse((left + right) / 2, (top + bottom) / 2, Math.abs(right - left) / 2, Math.abs(bottom - top) / 2, 0, 0, 2 * Math.PI);
  else if (kind === "line") path.addPath(new Path2D(`M${left} ${top}L${right} ${bottom}`));
  else path.addPath(new Path2D(`M${corners.map((corner) => corner.join(" ")).join("L")}Z`));
  return path;
}

function hatch(kind, size) {
  const context = surface(size, size); // 2: lines, dark beside light; 1: dots
  for (let at = 0; at < 2 * size; at++) {
    if (kind === 1 && at !== size >> 1) continue;
    context.fillStyle = "#000000a0";
    context.fillRect(at % size, size - 1 - (at % size), size / 4, size / 4);
    context.fillStyle = "#ffffffd0";
    context.fillRect(at % size, size - 1 - (at % size), size / 8, size / 8);
  }
  return context.canvas;
}

class Picture {
  constructor(explorer, pane) {
    Object.assign(this, { explorer, pane, codes: null, limits: null, sides: null });
    this.box = make(null, "div", "dbt-picture");
    this.title = make(this.box, "button", "dbt-title", {
      type: "button", textContent: capital(pane.label), title: "plot the curves of this", disabled: pane.kind === "status", onclick: () => explorer.choose(pane),
    });
    this.readout = make(this.box, "div", "dbt-readout");
    this.canvas = make(this.box, "canvas", "dbt-canvas", { tabIndex: 0 });
    this.canvas.dataset.pane = pane.name;
    this.foot = make(this.box, "div", "dbt-foot");
    if (pane.kind === "status") this.addLegend();
    else this.addScale();
    this.image = surface(explorer.shape[1], explorer.shape[0]);
    this.pixels = this.image.getImageData(0, 0, explorer.shape[1], explorer.shape[0]);
    this.colors = new Uint32Array(this.pixels.data.buffer);
    explorer.listen(this.canvas);
  }
  addLegend() {
    for (const [words, color, share] of this.explorer.legend) {
      make(this.foot, "i", "dbt-swatch").style.background = color;
      make(this.foot, "span", "dbt-entry", { textContent: `${words}, ${(100 * share).toFixed(share < 0.1 ? 1 : 0)} %` });
    }
  }
  addScale() {
    const number = (place, title) => make(this.foot, "input", "dbt-number", {
      type: "number", step: "any", title, ariaLabel: `${this.pane.label}: ${title}`,
      onchange: ({ target }) => {
        const limits = this.range.with(place, parseFloat(target.value) + this.explorer.zero(this.pane));
        this.rescale(limits[0] < limits[1] ? limits : this.limits);
      },
    });
    this.low = number(0, "colour range begins");
    this.bar = make(this.foot, "canvas", "dbt-bar", { width: 256, height: 24, title: "histogram of this frame, above its colours" });
    this.high = number(1, "colour range ends");
    this.unit = make(this.foot, "span");
    make(this.foot, "button", "dbt-button", { type: "button", textContent: "auto", title: "range of the whole film", onclick: () => this.rescale(null) });
  }
  rescale(limits) {
    Object.assign(this, { limits, codes: null });
    this.explorer.goTo(this.explorer.index);
  }
  take(codes, range, sides, spots) {
    Object.assign(this, { codes, range, sides, spots });
    this.paint();
  }
  paint() {
    if (!this.codes) return;
    const { explorer, pane, colors, codes } = this;
    const [hidden, table] = pane.kind === "status" ? [new Uint8Array(codes.length), explorer.statusColors] : [explorer.hidden, explorer.palettes[explorer.palette]];
    for (let at = 0; at < colors.length; at++) colors[at] = hidden[at] ? 0 : table[codes[at]];
    if (pane.kind !== "status") this.paintScale(table);
    this.image.putImageData(this.pixels, 0, 0);
    explorer.redraw([this]);
  }
  paintScale(palette) {
    const { explorer, pane, range: [from, to] } = this;
    const [bar, scale] = [this.bar.getContext("2d"), new ImageData(256, 1)], numbers = new Array(256).fill(0);
    new Uint32Array(scale.data.buffer).set(palette);
    bar.clearRect(0, 0, 256, 24);
    for (let row = 16; row < 24; row++) bar.putImageData(scale, 0, row);
    for (const code of this.codes) numbers[code] += 1;
    numbers[0] = 0; // no value
    const most = Math.max(1, ...numbers.slice(2, 255)); // both ends hold all that is beyond the range
    bar.fillStyle = getComputedStyle(this.foot).color;
    numbers.forEach((number, at) => { const high = Math.min(15, (15 * number) / most); bar.fillRect(at, 16 - high, 1, high); });
    [this.low.value, this.high.value] = [explorer.text(from, pane), explorer.text(to, pane)];
    this.unit.textContent = explorer.shownUnit(pane);
  }
  draw() {
    const { explorer, canvas, pane, explorer: { zoom: { x, y, factor }, cursor, shape } } = this;
    const width = Math.max(1, Math.round(canvas.clientWidth * devicePixelRatio));
    const height = Math.max(1, Math.round((width * shape[0]) / shape[1]));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const context = canvas.getContext("2d");
    const size = (width / shape[1]) * factor;
    const place = (column, row) => [(column - x) * size, (row - y) * size];
    context.imageSmoothingEnabled = false;
    context.fillStyle = "#b8b8b8";
    context.fillRect(0, 0, width, height);
    context.drawImage(this.image.canvas, ...place(0, 0), shape[1] * size, shape[0] * size);
    if (pane.kind !== "status") context.drawImage(explorer.hatching(width, height, size), 0, 0);
    if (this.sides) stroke(context, isotherm(this.sides, shape[1], place), ["black", 3], ["#7fffd4", 1.5]);
    for (const [, region, color] of explorer.shownRegions()) stroke(context, outline(region, place), ["white", 4], [color, 2]);
    (this.spots ?? []).forEach(([row, column, value], hot) => {
      const [across, down] = place(column + 0.5, row + 0.5), tip = hot ? -9 : 9;
      stroke(context, new Path2D(`M${across} ${down}l-5 ${tip}h10z`), ["black", 3], ["white", 1.5]);
      Object.assign(context, { font: `${11 * devicePixelRatio}px sans-serif`, textAlign: across > width / 2 ? "right" : "left", lineWidth: 3 * devicePixelRatio, lineJoin: "round", strokeStyle: "black", fillStyle: "white" });
      const label = [explorer.text(value, pane), across + (across > width / 2 ? -8 : 8), down + (hot ? -4 : 12)];
      context.strokeText(...label);
      context.fillText(...label);
    });
    if (cursor) {
      const [across, down] = place(cursor[1] + 0.5, cursor[0] + 0.5);
      const cross = (near, far) => `M${across - far} ${down}h${far - near}M${across + near} ${down}h${far - near}`
        + `M${across} ${down - far}v${far - near}M${across} ${down + near}v${far - near}`;
      stroke(context, new Path2D(cross(5, 15)), ["black", 3], ["white", 1]);
    }
    this.title.classList.toggle("dbt-chosen", explorer.chosen === pane.name);
    this.title.textContent = capital(pane.label) + (explorer.isDifference(pane) ? `, less that at ${explorer.time[explorer.reference].toFixed(2)} s` : "");
    this.readout.textContent = cursor ? this.words(cursor) : "";
  }
  words([row, column]) {
    const { explorer, pane } = this;
    if (pane.kind === "status") return explorer.legend[this.codes[row * explorer.shape[1] + column]][0];
    const [value, std] = explorer.probed?.[pane.name] ?? [];
    if (value === undefined) return "\u2026";
    if (value === null) return "no value";
    return `${explorer.text(value, pane)}${std === null ? "" : ` \u00b1 ${std.toFixed(DIGITS[pane.units] ?? 2)}`} ${explorer.shownUnit(pane)}`;
  }
}

class Explorer {
  constructor(model, el) {
    Object.assign(this, { pictures: new Map(), shown: [], changed: new Set(), curves: new Map(), regions: new Map(), past: [], events: {}, drawn: -1, number: 1 });
    Object.assign(this, { zoom: { x: 0, y: 0, factor: 1 }, cursor: null, probed: null, selection: "unflagged", palette: 0, isotherm: null, reference: null });
    this.root = make(el, "div", "dbt-explorer");
    Object.assign(this.root.dataset, { testid: "explorer", lmSuppressShortcuts: "true" }); // or JupyterLab takes the arrow keys
    this.root.explorer = this;
    this.message = make(this.root, "div", "dbt-faint", { textContent: "waiting for the kernel \u2026" });
    this.link = new Link(model, (...answer) => this.take(...answer));
    this.link.ask("start");
  }
  close() {
    clearInterval(this.player);
    for (const observer of [this.observer, this.themes]) observer?.disconnect();
    this.link.model.off("msg:custom", this.link.listener);
  }
  take(kind, message, buffers = []) {
    const bytes = (i) => new Uint8Array(buffers[i].buffer, buffers[i].byteOffset, buffers[i].byteLength);
    const copy = (i, Type) => new Type(bytes(i).slice().buffer);
    const text = message.error ?? message.progress ?? "";
    // An error stays while the pointer moves.
    if (text || kind !== "probe" || !this.message.matches(".dbt-wrong")) this.say(text, kind === "error");
    ({
      start: () => this.panes || this.build(message, copy),
      frames: () => {
        const sides = (name) => (message.lined.includes(name) ? bytes(message.panes.length + message.lined.indexOf(name)) : null);
        message.panes.forEach((name, i) => this.pictures.get(name).take(bytes(i), message.ranges[i], sides(name), message.spots[name]));
        this.shownIndex = message.index;
      },
      profile: () => { this.profile = copy(0, Float32Array); },
      probe: () => { this.probed = message.values; },
      curves: () => {
        this.curves = new Map(message.names.map((name, i) => [name, { values: copy(i, Float32Array), counts: message.counts[i] }]));
        this.plotted = this.panes.find((pane) => pane.name === message.pane);
      },
      event: () => this.placeMarks(message.events),
      code: () => this.showText(message.text),
      export: () => {
        const href = URL.createObjectURL(new Blob([bytes(0)]));
        make(null, "a", "", { href, download: message.name }).click();
        setTimeout(() => URL.revokeObjectURL(href), 1000);
      },
    })[kind]?.();
    if (this.panes) this.redraw(kind === "frames" ? [] : undefined);
  }
  say(text, wrong = false) {
    this.message.textContent = text || HELP;
    this.message.classList.toggle("dbt-wrong", wrong);
    if (wrong) this.message.scrollIntoView({ block: "nearest" }); // it lies below all pictures
  }

  // The page
  build({ regions, palettes, ...setup }, copy) {
    Object.assign(this, setup, { paletteNames: palettes, classes: copy(0, Uint8Array) });
    this.palettes = palettes.map((_, i) => copy(2 + i, Uint32Array).fill(0, 0, 1)); // 0 is no value
    this.statusColors = setup.legend.map(([, color]) => parseInt(`ff${color.slice(5)}${color.slice(3, 5)}${color.slice(1, 3)}`, 16));
    for (const [name, kind, points] of regions) this.regions.set(name, { kind, points });
    this.number = regions.length + 1;
    this.shown = setup.panes.filter((pane) => pane.shown).map((pane) => pane.name);
    this.chosen = (setup.panes.find((pane) => pane.name === "object_temperature") ?? setup.panes[0]).name;
    this.buildTools();
    this.grid = make(this.root, "div", "dbt-grid");
    this.buildTime();
    this.buildPlot();
    this.root.appendChild(this.message);
    this.root.addEventListener("keydown", (event) => this.key(event));
    this.observer = new ResizeObserver(() => this.redraw());
    this.observer.observe(this.root);
    this.themes = new MutationObserver(() => this.repaint()); // pictures draw in the colour of the text
    this.themes.observe(document.body, { attributes: true, attributeFilter: ["data-jp-theme-light"] });
    this.repaint();
    this.arrange(copy(1, Uint8Array));
    this.askCurves();
  }
  button(parent, textContent, title, onclick) {
    return make(parent, "button", "dbt-button", { type: "button", textContent, title, onclick });
  }
  select(parent, label, options, action) {
    const list = make(make(parent, "label", "dbt-label", { textContent: label }), "select", "", { ariaLabel: label, onchange: () => action(list.value) });
    for (const [value, textContent] of Object.entries(options)) make(list, "option", "", { value, textContent });
  }
  buildTools() {
    const bar = make(this.root, "div", "dbt-row");
    const tools = make(bar, "span", "dbt-group");
    this.tools = Object.entries(TOOLS).map(([tool, text]) => {
      const button = this.button(tools, text, tool === "move" ? "drag a picture, or a region in it" : `draw a region: ${tool}`, () => this.useTool(tool));
      button.dataset.tool = tool;
      return button;
    });
    this.useTool("move");
    this.select(bar, "colours", this.paletteNames.map((name) => PALETTES[name] ?? name), (value) => { this.palette = value; this.repaint(); });
    this.select(bar, "pixels", PIXELS, (value) => { this.selection = value; this.repaint(); this.askCurves(); });
    const name = () => (this.celsius ? "\u00b0C" : "K");
    const unit = this.button(bar, name(), "kelvin or degrees Celsius", () => {
      if (this.isotherm !== null) this.setIsotherm(this.isotherm + (this.celsius ? ZERO_CELSIUS : -ZERO_CELSIUS));
      this.celsius = !this.celsius;
      unit.textContent = name();
      this.repaint();
    });
    const line = make(bar, "label", "dbt-label", { textContent: "isotherm" });
    const set = () => this.setIsotherm(this.level.value === "" ? null : parseFloat(this.level.value));
    this.level = make(line, "input", "dbt-number", { type: "number", step: "any", placeholder: "none", ariaLabel: "isotherm", onchange: set });
    const out = make(bar, "span", "dbt-group");
    this.button(out, "Copy as code", "Python that gives this frame and these curves", () => this.askFor("code"));
    for (const [suffix, what] of Object.entries(FILES)) {
      this.button(out, suffix === ".nc" ? "NetCDF" : suffix.slice(1).toUpperCase(), `save ${what}`, () => this.askFor("export", { suffix }));
    }
    const list = make(bar, "details", "dbt-panes");
    make(list, "summary", "", { textContent: "Pictures" });
    const entries = make(list, "div", "dbt-list");
    for (const pane of this.panes) {
      const entry = make(entries, "label", "dbt-label");
      const onchange = () => {
        this.shown = this.panes.map((one) => one.name).filter((one) => (one === pane.name ? box.checked : this.shown.includes(one)));
        this.arrange();
      };
      const box = make(entry, "input", "", { type: "checkbox", checked: pane.shown, onchange });
      entry.append(capital(pane.label));
    }
    make(bar, "span", "dbt-note", { textContent: this.note });
  }
  buildTime() {
    const row = make(this.root, "div", "dbt-row");
    this.playButton = this.button(row, "\u25b6", "play or stop (space)", () => this.play());
    const track = make(row, "div", "dbt-track");
    this.slider = make(track, "input", "dbt-slider", { type: "range", min: 0, max: this.time.length - 1, value: this.index, ariaLabel: "frame" });
    this.slider.dataset.testid = "time";
    this.slider.oninput = () => this.goTo(+this.slider.value);
    this.marks = make(track, "div", "dbt-marks");
    this.clock = make(row, "span", "dbt-clock");
    this.placeMarks(this.events);
  }
  placeMarks(events) {
    this.events = events;
    const [first, last] = [this.time[0], this.time.at(-1)];
    this.marks.replaceChildren(...Object.entries(events).filter(([, at]) => first <= at && at <= last).map(([name, at]) => {
      const mark = make(null, "i", "dbt-mark", { title: `${name}, ${at.toFixed(2)} s` });
      mark.style.left = `calc(8px + (100% - 16px) * ${(at - first) / (last - first || 1)})`; // as the slider's thumb
      return mark;
    }));
  }
  buildPlot() {
    const row = make(this.root, "div", "dbt-curves");
    this.plot = make(row, "canvas", "dbt-plot");
    this.plot.onclick = ({ offsetX }) => {
      if (!this.axes) return;
      const share = (offsetX - this.axes[0]) / (this.axes[1] - this.axes[0]);
      const later = this.time.findIndex((one) => one >= this.time[0] + share * (this.time.at(-1) - this.time[0]));
      this.goTo(later < 0 ? this.time.length - 1 : later);
    };
    this.list = make(row, "div", "dbt-regions");
    this.section = make(this.root, "canvas", "dbt-section");
  }
  arrange(statusCodes) {
    this.grid.replaceChildren(...this.shown.map((name) => {
      if (!this.pictures.has(name)) this.pictures.set(name, new Picture(this, this.panes.find((pane) => pane.name === name)));
      return this.pictures.get(name).box;
    }));
    if (statusCodes) this.pictures.get("status")?.take(statusCodes);
    this.goTo(this.index);
  }
  showText(value) {
    const dialog = make(this.root, "div", "dbt-dialog");
    make(dialog, "textarea", "", { value, readOnly: true, rows: value.split("\n").length }).select();
    dialog.scrollIntoView({ block: "nearest" });
    navigator.clipboard?.writeText(value).then(() => this.say("copied"), () => this.say("select and copy"));
    this.button(dialog, "Close", "", () => dialog.remove());
  }

  // What is asked of Python
  goTo(index) {
    this.index = this.slider.value = clamp(index, 0, this.time.length - 1);
    const panes = this.shown.filter((name) => this.pictures.get(name).pane.kind === "film" || !this.pictures.get(name).codes);
    const limits = panes.map((name) => this.pictures.get(name).limits);
    const isotherm = this.isotherm === null ? null : this.isotherm + (this.celsius ? ZERO_CELSIUS : 0);
    this.link.ask("frames", { index: this.index, panes, limits, isotherm, reference: this.reference });
    this.askProbe();
    this.askProfile();
  }
  askProfile() {
    if (this.line) this.link.ask("profile", { index: this.index, pane: this.chosen, points: this.line.points, reference: this.reference });
  }
  askProbe() {
    if (this.cursor) this.link.ask("probe", { index: this.index, row: this.cursor[0], column: this.cursor[1], panes: this.shown, reference: this.reference });
  }
  counted() { return this.selection === "hidden" ? "unflagged" : this.selection; }
  askCurves() {
    const regions = [...this.regions].map(([name, { kind, points }]) => [name, kind, points]);
    this.link.ask("curves", { pane: this.chosen, pixels: this.counted(), regions });
  }
  askFor(kind, more = {}) {
    const limits = Object.fromEntries([...this.pictures].filter(([name, one]) => one.range && name !== "status").map(([name, one]) => [name, one.range]));
    const panes = [this.chosen, ...this.shown.filter((name) => name !== this.chosen)];
    this.link.ask(kind, { panes, index: this.index, pixels: this.counted(), celsius: this.celsius, palette: this.paletteNames[this.palette], limits, ...more });
  }

  // What the user does
  useTool(tool) {
    Object.assign(this, { tool, draft: null });
    for (const button of this.tools) button.classList.toggle("dbt-chosen", button.dataset.tool === tool);
  }
  choose(pane) {
    this.chosen = pane.name;
    this.askCurves();
    this.askProfile();
  }
  remember() { this.past.push([...this.regions].map(([name, region]) => [name, { ...region }])); }
  undo() {
    if (!this.past.length) return;
    this.regions = new Map(this.past.pop());
    this.askCurves();
  }
  remove(name) {
    if (!this.regions.has(name)) return;
    this.remember();
    this.regions.delete(name);
    this.askCurves();
  }
  setIsotherm(value) {
    this.isotherm = value;
    this.level.value = value === null ? "" : +value.toFixed(2);
    this.goTo(this.index);
  }
  setReference(index) {
    // Films less their frame at an index, whose ranges are others; null for the films themselves.
    this.reference = index;
    for (const picture of this.pictures.values()) if (picture.pane.kind === "film") Object.assign(picture, { limits: null, codes: null });
    this.goTo(this.index);
  }
  play() {
    const starts = !this.player;
    clearInterval(this.player);
    const next = () => this.link.busy || this.goTo((this.index + 1) % this.time.length);
    this.player = starts ? setInterval(next, 60) : null;
    this.playButton.textContent = starts ? "\u25a0" : "\u25b6";
  }
  key(event) {
    if (event.target.matches("input[type=number], textarea, select")) return event.stopPropagation();
    const step = event.shiftKey ? 10 : 1;
    const actions = {
      ArrowRight: () => this.goTo(this.index + step),
      ArrowLeft: () => this.goTo(this.index - step),
      Home: () => this.goTo(0),
      End: () => this.goTo(this.time.length - 1),
      " ": () => this.play(),
      r: () => this.setReference(this.reference === null ? this.index : null),
      m: () => this.link.ask("event", { name: `mark ${Object.keys(this.events).length + 1}`, time: this.time[this.index] }),
      Escape: () => { this.draft = this.line = this.profile = null; this.redraw(); },
      Delete: () => this.remove(this.regions.has(this.selected) ? this.selected : [...this.regions.keys()].at(-1)),
      z: () => this.undo(),
      Enter: () => this.finish(),
    };
    const pressed = [" ", "Enter"].includes(event.key) && event.target.matches("button, summary");
    if (!actions[event.key] || (event.key === "z") !== (event.ctrlKey || event.metaKey) || pressed) return;
    actions[event.key]();
    event.preventDefault();
    event.stopPropagation();
  }
  listen(canvas) {
    const place = (event) => {
      const size = (canvas.clientWidth / this.shape[1]) * this.zoom.factor;
      return [event.offsetY / size + this.zoom.y, event.offsetX / size + this.zoom.x];
    };
    canvas.onpointerdown = (event) => {
      if (event.button) return;
      canvas.focus();
      canvas.setPointerCapture(event.pointerId);
      this.press(place(event));
    };
    canvas.onpointermove = (event) => this.drag(place(event), event.buttons);
    canvas.onpointerup = () => { this.grip = null; if (this.draft?.kind !== "polygon") this.finish(); };
    canvas.onpointerleave = () => { this.cursor = null; this.redraw(); };
    canvas.ondblclick = () => (this.tool === "polygon" ? this.finish() : this.moveZoom(0, 0, 1));
    canvas.onwheel = (event) => {
      if (document.activeElement !== canvas) return; // the page scrolls until a picture is clicked
      event.preventDefault();
      const [row, column] = place(event);
      const factor = clamp(this.zoom.factor * 2 ** (-event.deltaY / 400), 1, 64);
      const ratio = this.zoom.factor / factor;
      this.moveZoom(column - (column - this.zoom.x) * ratio, row - (row - this.zoom.y) * ratio, factor);
    };
  }
  moveZoom(x, y, factor) {
    const [height, width] = this.shape;
    this.zoom = { x: clamp(x, 0, width - width / factor), y: clamp(y, 0, height - height / factor), factor };
    this.redraw();
  }
  press(at) {
    if (this.tool === "polygon") this.draft = { kind: "polygon", points: [...(this.draft?.points ?? []), at] };
    else if (this.tool !== "move") this.draft = { kind: this.tool, points: [at, at] };
    else {
      const [name, region] = [...this.regions].reverse().find(([, one]) => surface(1, 1).isPointInPath(outline(one), at[1], at[0])) ?? [];
      if (region) this.remember();
      this.selected = name ?? this.selected;
      this.grip = { at, region, points: region?.points };
    }
    this.redraw();
  }
  drag(at, pressed) {
    const [row, column] = at.map(Math.floor);
    const within = row >= 0 && column >= 0 && row < this.shape[0] && column < this.shape[1];
    const moved = within && String(this.cursor) !== String([row, column]);
    this.cursor = within ? [row, column] : null;
    if (this.draft && this.draft.kind !== "polygon") this.draft.points = [this.draft.points[0], at.map((one, i) => clamp(one, 0, this.shape[i]))];
    else if (this.grip?.region) { // which stays in the image
      const ends = [0, 1].map((i) => this.grip.points.map((point) => point[i]));
      const step = ends.map((all, i) => clamp(at[i] - this.grip.at[i], -Math.min(...all), this.shape[i] - Math.max(...all)));
      this.grip.region.points = this.grip.points.map((point) => point.map((one, i) => rounded(one + step[i])));
      this.askCurves();
    } else if (this.grip) this.moveZoom(this.zoom.x + this.grip.at[1] - at[1], this.zoom.y + this.grip.at[0] - at[0], this.zoom.factor);
    if (moved && !pressed) this.askProbe();
    this.redraw();
  }
  finish() {
    const points = this.draft?.points.filter((one, i, all) => !i || Math.hypot(one[0] - all[i - 1][0], one[1] - all[i - 1][1]) > 0.1) ?? [];
    if (this.tool === "line" && points.length === 2) {
      this.line = { kind: "line", points: points.map((point) => point.map(rounded)) };
      this.askProfile();
    }
    const wide = this.tool !== "line" && [0, 1].every((i) => Math.max(...points.map((one) => one[i])) - Math.min(...points.map((one) => one[i])) > 0.5);
    if (wide && points.length >= (this.tool === "polygon" ? 3 : 2)) {
      this.remember();
      this.selected = `region ${this.number++}`;
      this.regions.set(this.selected, { kind: this.draft.kind, points: points.map((point) => point.map(rounded)) });
      this.askCurves();
    }
    this.draft = null;
    this.redraw();
  }

  // What is drawn
  offset(pane) { return pane.absolute && this.celsius ? ZERO_CELSIUS : 0; }
  unit(pane) { return pane.absolute && this.celsius ? "\u00b0C" : pane.units; }
  zero(pane) { return this.isDifference(pane) ? 0 : this.offset(pane); } // of what pictures show
  shownUnit(pane) { return this.isDifference(pane) ? pane.units : this.unit(pane); }
  isDifference(pane) { return this.reference !== null && pane.kind === "film"; }
  text(value, pane) { return (value - this.zero(pane)).toFixed(DIGITS[pane.units] ?? 2); }
  repaint() {
    this.hidden = this.classes.map((one) => HIDDEN[this.selection][one]);
    for (const picture of this.pictures.values()) picture.paint();
  }
  shownRegions() {
    const all = [...this.regions].map(([name, region], i) => [name, region, this.colors[i % this.colors.length]]);
    return [...all, ...[this.line, this.draft].filter(Boolean).map((region) => ["", region, "#000000"])];
  }
  hatching(width, height, size) {
    const key = [width, height, size, this.zoom.x, this.zoom.y, this.selection].join();
    if (this.hatched?.key === key) return this.hatched.canvas;
    const whole = surface(width, height);
    for (const kind of [1, 2]) {
      if (HIDDEN[this.selection][kind] || !this.classes.includes(kind)) continue;
      const mask = surface(this.shape[1], this.shape[0]);
      const pixels = new ImageData(this.shape[1], this.shape[0]);
      this.classes.forEach((one, at) => { pixels.data[4 * at + 3] = one === kind ? 255 : 0; });
      mask.putImageData(pixels, 0, 0);
      const layer = surface(width, height);
      layer.imageSmoothingEnabled = false;
      layer.drawImage(mask.canvas, -this.zoom.x * size, -this.zoom.y * size, this.shape[1] * size, this.shape[0] * size);
      layer.globalCompositeOperation = "source-in";
      layer.fillStyle = layer.createPattern(hatch(kind, Math.round(8 * devicePixelRatio)), "repeat");
      layer.fillRect(0, 0, width, height);
      whole.drawImage(layer.canvas, 0, 0);
    }
    this.hatched = { key, canvas: whole.canvas };
    return whole.canvas;
  }
  redraw(pictures = this.shown.map((name) => this.pictures.get(name))) {
    for (const picture of pictures) this.changed.add(picture);
    this.pending ??= requestAnimationFrame(() => {
      this.pending = null;
      for (const picture of this.changed) if (this.shown.includes(picture?.pane.name)) picture.draw();
      this.changed.clear();
      this.clock.textContent = `${this.time[this.index].toFixed(2)} s  (frame ${this.index}, last ${this.time.length - 1})`;
      this.drawPlot();
      this.drawProfile();
      this.drawn = this.shownIndex;
    });
  }
  curve(name) {
    // Mean, least, greatest value and deviation of the mean, each a function of the frame, in the unit shown.
    const found = this.curves.get(name);
    if (!found) return null;
    const length = found.values.length / 4;
    const part = (place, zero) => (i) => found.values[place * length + (length === 1 ? 0 : i)] - zero;
    const zero = this.offset(this.plotted);
    return { mean: part(0, zero), low: part(1, zero), high: part(2, zero), std: part(3, 0), counts: found.counts };
  }
  drawPlot() {
    const regions = this.shownRegions().map(([name, , color]) => [name, color, this.curve(name)]).filter(([, , curve]) => curve);
    this.listRegions(regions);
    const [width, height] = [this.plot.clientWidth, this.plot.clientHeight];
    Object.assign(this.plot, { width: width * devicePixelRatio, height: height * devicePixelRatio });
    const context = this.plot.getContext("2d");
    context.scale(devicePixelRatio, devicePixelRatio);
    const ink = getComputedStyle(this.root).color;
    Object.assign(context, { font: "12px sans-serif", fillStyle: ink });
    this.axes = regions.length ? [64, width - 12] : null;
    if (!this.axes) return context.fillText("Rectangle, Ellipse or Polygon: draw a region in a picture to see its curve here.", 12, 24, width - 24);
    const ends = regions.flatMap(([, , curve]) => this.time.flatMap((_, i) => [curve.low(i), curve.high(i), ...interval(curve, i)])).filter(Number.isFinite);
    const range = ends.length ? [ends.reduce((a, b) => Math.min(a, b)), ends.reduce((a, b) => Math.max(a, b))] : [0, 1];
    const margin = Math.max(0.06 * (range[1] - range[0]), 1e-3);
    const [low, high] = [range[0] - margin, range[1] + margin];
    const [left, right, top, bottom] = [...this.axes, 12, height - 36];
    const [begin, end] = [this.time[0], this.time.at(-1)];
    const across = (moment) => left + ((moment - begin) / (end - begin || 1)) * (right - left);
    const down = (value) => bottom - ((value - low) / (high - low)) * (bottom - top);
    const line = (path, strokeStyle, dashes = []) => {
      Object.assign(context, { strokeStyle, lineWidth: 1 });
      context.setLineDash(dashes);
      context.stroke(new Path2D(path));
    };
    const vertical = (moment) => `M${across(moment)} ${top}V${bottom}`;
    context.textAlign = "right";
    for (const [at, text] of ticks(low, high, (bottom - top) / 40)) {
      context.fillText(text, left - 6, down(at) + 4);
      line(`M${left} ${down(at)}H${right}`, "#8884");
    }
    context.textAlign = "center";
    for (const [at, text] of ticks(begin, end, (right - left) / 90)) {
      context.fillText(text, across(at), bottom + 15);
      line(vertical(at), "#8884");
    }
    context.fillText("time [s]", (left + right) / 2, height - 5);
    context.save();
    context.translate(13, (top + bottom) / 2);
    context.rotate(-Math.PI / 2);
    const unit = this.unit(this.plotted);
    context.fillText(this.plotted.label + (unit && ` [${unit}]`), 0, 0, bottom - top + 40);
    context.restore();
    for (const moment of Object.values(this.events)) line(vertical(moment), "#d1495b", [3, 3]);
    line(vertical(this.time[this.index]), ink);
    for (const [, color, curve] of regions) this.drawCurve(context, color, curve, (i) => across(this.time[i]), down);
  }
  drawProfile() {
    // Values of the chosen picture along the line, at this frame.
    const { section, profile, line } = this, pane = this.panes.find((one) => one.name === this.chosen);
    section.hidden = !line || !profile;
    if (section.hidden) return;
    const [width, height, values] = [section.clientWidth, section.clientHeight, [...profile].map((value) => value - this.zero(pane))];
    Object.assign(section, { width: width * devicePixelRatio, height: height * devicePixelRatio });
    const context = section.getContext("2d"), [left, right, top, bottom] = [64, width - 12, 18, height - 32];
    context.scale(devicePixelRatio, devicePixelRatio);
    Object.assign(context, { font: "12px sans-serif", fillStyle: getComputedStyle(this.root).color, strokeStyle: "#8884" });
    const finite = values.filter(Number.isFinite), [from, to] = line.points;
    context.fillText(`${this.pictures.get(pane.name).title.textContent} along the line ${this.shownUnit(pane) && `[${this.shownUnit(pane)}]`}`, left, 12);
    if (!finite.length) return;
    const length = Math.hypot(to[0] - from[0], to[1] - from[1]), margin = Math.max(0.06 * (Math.max(...finite) - Math.min(...finite)), 1e-3);
    const [low, high] = [Math.min(...finite) - margin, Math.max(...finite) + margin];
    const across = (at) => left + (at / length) * (right - left), down = (value) => bottom - ((value - low) / (high - low)) * (bottom - top);
    context.textAlign = "right";
    for (const [at, text] of ticks(low, high, (bottom - top) / 30)) { context.fillText(text, left - 6, down(at) + 4); context.stroke(new Path2D(`M${left} ${down(at)}H${right}`)); }
    context.textAlign = "center";
    for (const [at, text] of ticks(0, length, (right - left) / 90)) { context.fillText(text, across(at), bottom + 14); context.stroke(new Path2D(`M${across(at)} ${top}V${bottom}`)); }
    context.fillText("distance [pixel]", (left + right) / 2, height - 4);
    Object.assign(context, { strokeStyle: this.colors[0], lineWidth: 2 });
    const point = (value, i) => `${across((length * i) / (values.length - 1))} ${down(value)}`;
    context.stroke(new Path2D(values.map((value, i) => (Number.isFinite(value) ? `${i && Number.isFinite(values[i - 1]) ? "L" : "M"}${point(value, i)}` : "")).join("")));
  }
  drawCurve(context, color, { mean, low, high, std }, across, down) {
    const point = (i, value) => `${across(i)} ${down(value)}`;
    const runs = this.time.map((_, i) => i).filter((i) => Number.isFinite(mean(i)));
    const corners = (i) => [[i, 1], [i + 1, 1], [i + 1, 0], [i, 0]].map(([at, end]) => point(at, interval({ mean, std }, at)[end]));
    const steps = runs.filter((i) => i + 1 < this.time.length && Number.isFinite(std(i) + std(i + 1)));
    context.fillStyle = `${color}44`;
    context.fill(new Path2D(steps.map((i) => `M${corners(i).join("L")}Z`).join(""))); // at once: without seams
    for (const [value, lineWidth, dashes] of [[low, 1, [2, 3]], [high, 1, [2, 3]], [mean, 2, []]]) {
      Object.assign(context, { strokeStyle: color, lineWidth });
      context.setLineDash(dashes);
      context.stroke(new Path2D(runs.map((i, at) => `${runs[at - 1] === i - 1 ? "L" : "M"}${point(i, value(i))}`).join("")));
    }
  }
  listRegions(regions) {
    const digits = DIGITS[this.plotted?.units] ?? 2;
    const lines = regions.map(([name, color, { mean, low, high, std, counts }], order) => {
      const [i, line] = [this.index, make(null, "div", "dbt-region")];
      make(line, "i", "dbt-swatch").style.background = color;
      make(line, "b", "", { textContent: name });
      this.button(line, "\u00d7", `remove ${name}`, () => this.remove(name));
      const bar = Number.isNaN(std(i)) ? "" : ` \u00b1 ${std(i).toFixed(digits + (std(i) < 0.05 ? 1 : 0))}`;
      make(line, "div", "", { textContent: `mean ${mean(i).toFixed(digits)}${bar} ${this.unit(this.plotted)}` });
      make(line, "div", "dbt-faint", { textContent: `${low(i).toFixed(digits)} to ${high(i).toFixed(digits)}; ${counts[1]} of ${counts[0]} pixels` });
      const unit = this.plotted?.absolute ? "K" : this.unit(this.plotted);
      const since = this.reference;
      if (since !== null && this.plotted?.kind === "film") make(line, "div", "dbt-faint", { textContent: `since ${this.time[since].toFixed(2)} s: ${(mean(i) - mean(since)).toFixed(digits)} ${this.plotted.units}` });
      if (order) make(line, "div", "dbt-faint", { textContent: `less ${regions[0][0]}: ${(mean(i) - regions[0][2].mean(i)).toFixed(digits)} ${unit}` });
      return line;
    });
    if (lines.length) lines.push(make(null, "div", "dbt-faint", { textContent: "line: mean, with its 95 % interval; dotted: least and greatest pixel" }));
    const text = lines.map((line) => line.textContent).join();
    if (text !== this.listed) this.list.replaceChildren(...lines);
    this.listed = text;
  }
}

export default {
  render({ model, el }) { const explorer = new Explorer(model, el); return () => explorer.close(); },
};
