// Viewer of a report: one quantity as a picture, its curve at a pixel, and the time by slider or keys.
{
  const root = document.currentScript.parentElement;
  const film = JSON.parse(root.querySelector("script[type='application/json']").textContent);
  const { height, width, times, palette, quantities } = film;
  const NOTHING = 65535; // of 16 bits: no value here
  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const lut = bytes(palette);
  // Codes are stored as their changes from frame to frame, low bytes before high ones, deflated.
  async function unpack(quantity) {
    const stream = new Blob([bytes(quantity.data)]).stream().pipeThrough(new DecompressionStream("deflate"));
    const planes = new Uint8Array(await new Response(stream).arrayBuffer()), number = planes.length / 2, size = height * width;
    const codes = new Uint16Array(number);
    for (let at = 0; at < number; at++) codes[at] = planes[at] + 256 * planes[number + at] + (at < size ? 0 : codes[at - size]);
    quantity.codes = codes;
  }
  const find = (name) => root.querySelector(`[data-part=${name}]`);
  const [picture, bar, curve, slider, choice, readout, play] =
    ["picture", "bar", "curve", "time", "quantity", "readout", "play"].map(find);
  const scale = Math.max(1, Math.floor(Math.min(520 / width, 420 / height)));
  [picture.width, picture.height, curve.width, curve.height] = [width * scale, height * scale, 420, 300];
  [bar.width, bar.height] = [76, Math.max(160, picture.height)];
  const ink = () => getComputedStyle(root).color; // dark on light, or light on dark
  const small = new OffscreenCanvas(width, height), marks = bytes(film.marks);
  slider.max = times.length - 1;
  slider.value = Math.floor(times.length / 2);
  for (const each of quantities) choice.add(new Option(each.label, each.name));
  let pixel = [Math.floor(height / 2), Math.floor(width / 2)];
  let timer = 0;

  const shown = () => quantities[choice.selectedIndex];
  const value = (quantity, frame, row, column) => {
    const code = quantity.codes[(frame * height + row) * width + column];
    return code === NOTHING ? NaN : quantity.low + (quantity.high - quantity.low) * code / (NOTHING - 1);
  };
  const text = (number) => (Number.isNaN(number) ? "no value" : number.toFixed(2));

  // Round numbers between two ends, as text by value: about six.
  function ticks(low, high) {
    const rough = (high - low) / 6, power = 10 ** Math.floor(Math.log10(rough));
    const step = power * [1, 2, 5, 10].find((factor) => factor * power >= rough);
    const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9)), found = [];
    for (let at = Math.ceil(low / step - 1e-9); at * step <= high + 1e-9 * step; at++) {
      found.push([at * step, (at * step + 0).toFixed(digits).replace(/^-(0\.?0*)$/, "$1")]);
    }
    return found;
  }

  // Lines over the pixels that are completed (falling), or have another flag (rising), seen on dark and bright pixels.
  const lines = new OffscreenCanvas(picture.width, picture.height);
  for (const [kind, color, slope] of [[1, "#fff", 1], [2, "#000", -1]]) {
    const mask = new OffscreenCanvas(width, height), image = mask.getContext("2d").createImageData(width, height);
    marks.forEach((mark, at) => { image.data[4 * at + 3] = mark === kind ? 255 : 0; });
    mask.getContext("2d").putImageData(image, 0, 0);
    const layer = new OffscreenCanvas(picture.width, picture.height), context = layer.getContext("2d");
    Object.assign(context, { strokeStyle: color, shadowColor: kind === 1 ? "#000" : "#fff", shadowOffsetX: 1 });
    for (let at = -picture.height; at < picture.width + picture.height; at += 8) {
      context.moveTo(at, 0); context.lineTo(at + slope * picture.height, picture.height);
    }
    context.stroke();
    context.shadowColor = "transparent";
    context.globalCompositeOperation = "destination-in"; context.imageSmoothingEnabled = false;
    context.drawImage(mask, 0, 0, picture.width, picture.height);
    lines.getContext("2d").drawImage(layer, 0, 0);
  }

  function draw() {
    if (quantities.some((each) => !each.codes)) return;
    const quantity = shown(), frame = Number(slider.value);
    const context = picture.getContext("2d"), image = small.getContext("2d").createImageData(width, height);
    for (let row = 0, at = 0; row < height; row++) {
      for (let column = 0; column < width; column++, at += 4) {
        const here = value(quantity, frame, row, column);
        const share = (here - quantity.shown[0]) / (quantity.shown[1] - quantity.shown[0]);
        const index = 3 * Math.round(255 * Math.min(1, Math.max(0, share)));
        const gray = (row + column) % 4 < 2 ? 205 : 225; // hatched: no value
        for (let part = 0; part < 3; part++) image.data[at + part] = Number.isNaN(here) ? gray : lut[index + part];
        image.data[at + 3] = 255;
      }
    }
    small.getContext("2d").putImageData(image, 0, 0);
    context.imageSmoothingEnabled = false;
    context.drawImage(small, 0, 0, picture.width, picture.height);
    if (!quantity.name.startsWith("input")) context.drawImage(lines, 0, 0);
    // The pixel that the curve is of.
    const [x, y] = [(pixel[1] + 0.5) * scale, (pixel[0] + 0.5) * scale], arm = Math.max(7, scale);
    for (const [color, thick] of [["#000", 4], ["#fff", 2]]) {
      context.strokeStyle = color; context.lineWidth = thick; context.beginPath();
      for (const [right, down] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
        context.moveTo(x + right * arm / 2, y + down * arm / 2);
        context.lineTo(x + right * (arm + 6), y + down * (arm + 6));
      }
      context.stroke();
    }
    drawBar(quantity);
    const std = quantities.find((each) => each.name === `${quantity.name}_std`);
    const error = std ? ` ± ${text(value(std, frame, ...pixel))}` : "";
    const state = ["", ", completed and not measured", ", flagged"][marks[pixel[0] * width + pixel[1]]];
    const [row, column] = pixel.map((place) => place * film.step);
    readout.textContent = `${times[frame].toFixed(2)} s, row ${row}, column ${column}: ` +
      `${text(value(quantity, frame, ...pixel))}${error} ${quantity.unit}${state}`;
    drawCurve(quantity, std, frame);
  }

  function drawBar(quantity) {
    const context = bar.getContext("2d"), [low, high] = quantity.shown, [top, bottom] = [22, bar.height - 6];
    context.clearRect(0, 0, bar.width, bar.height);
    for (let y = top; y < bottom; y++) {
      const index = 3 * Math.round(255 * (bottom - y) / (bottom - top));
      context.fillStyle = `rgb(${lut[index]}, ${lut[index + 1]}, ${lut[index + 2]})`;
      context.fillRect(0, y, 16, 1);
    }
    context.fillStyle = ink(); context.font = "12px system-ui, sans-serif"; context.textAlign = "left";
    context.fillText(quantity.unit, 0, 13);
    for (const [at, label] of ticks(low, high)) {
      const y = bottom - (bottom - top) * (at - low) / (high - low);
      context.fillRect(16, y, 4, 1); context.fillText(label, 23, y + 4);
    }
  }

  function drawCurve(quantity, std, frame) {
    const context = curve.getContext("2d"), [left, top, right, bottom] = [58, 22, 402, 258];
    context.clearRect(0, 0, curve.width, curve.height);
    const values = times.map((_, index) => value(quantity, index, ...pixel));
    const errors = values.map((_, index) => (std ? 2 * value(std, index, ...pixel) : 0));
    const ends = values.flatMap((here, index) => [here - (errors[index] || 0), here + (errors[index] || 0)]).filter(Number.isFinite);
    context.fillStyle = context.strokeStyle = ink();
    context.font = "12px system-ui, sans-serif";
    if (ends.length === 0) { context.fillText("no value at this pixel", left + 20, top + 40); return; }
    let [low, high] = [Math.min(...ends), Math.max(...ends)];
    if (high - low < 0.1) [low, high] = [low - 0.05, high + 0.05];
    const last = times.length - 1, span = times[last] - times[0] || 1;
    const x = (index) => left + (right - left) * (times[index] - times[0]) / span;
    const y = (here) => bottom - (bottom - top) * (here - low) / (high - low);
    context.strokeRect(left, top, right - left, bottom - top);
    context.textAlign = "right";
    for (const [at, label] of ticks(low, high)) { context.fillRect(left - 3, y(at), 3, 1); context.fillText(label, left - 6, y(at) + 4); }
    context.textAlign = "center";
    for (const [at, label] of ticks(times[0], times[0] + span)) {
      const place = left + (right - left) * (at - times[0]) / span;
      context.fillRect(place, bottom, 1, 3); context.fillText(label, place, bottom + 16);
    }
    context.fillText("time [s]", (left + right) / 2, bottom + 34);
    context.textAlign = "left"; context.fillText(`${quantity.label} [${quantity.unit}]${std ? ", two standard deviations" : ""}`, left, top - 8);
    context.fillStyle = "#1b6ca855"; context.strokeStyle = getComputedStyle(root).getPropertyValue("--blue");
    // Two standard deviations, from frame to frame with values.
    context.beginPath();
    values.forEach((here, index) => {
      const [before, margins] = [index - 1, [errors[index - 1], errors[index]]];
      if (!Number.isFinite(here + values[before]) || !Number.isFinite(margins[0] + margins[1])) return;
      context.moveTo(x(before), y(values[before] + margins[0])); context.lineTo(x(index), y(here + margins[1]));
      context.lineTo(x(index), y(here - margins[1])); context.lineTo(x(before), y(values[before] - margins[0])); context.closePath();
    });
    context.fill();
    context.beginPath();
    values.forEach((here, index) => {
      if (Number.isFinite(here)) context[index && Number.isFinite(values[index - 1]) ? "lineTo" : "moveTo"](x(index), y(here));
    });
    context.stroke();
    context.strokeStyle = "#d1495b"; context.beginPath(); context.moveTo(x(frame), top); context.lineTo(x(frame), bottom); context.stroke();
  }

  picture.addEventListener("pointerdown", (event) => {
    const frame = picture.getBoundingClientRect();
    pixel = [
      Math.min(height - 1, Math.floor((event.clientY - frame.top) / frame.height * height)),
      Math.min(width - 1, Math.floor((event.clientX - frame.left) / frame.width * width)),
    ];
    draw();
  });
  slider.addEventListener("input", draw);
  choice.addEventListener("change", draw);
  play.addEventListener("click", () => {
    if (timer) { clearInterval(timer); timer = 0; play.textContent = "Play"; return; }
    play.textContent = "Pause";
    timer = setInterval(() => { slider.value = (Number(slider.value) + 1) % times.length; draw(); }, 80);
  });
  Promise.all(quantities.map(unpack)).then(draw);
}
