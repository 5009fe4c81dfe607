// Viewer of a report: one quantity as a picture, its curve at a pixel, and the time by slider or keys.
{
  const root = document.currentScript.parentElement;
  const film = JSON.parse(root.querySelector("script[type='application/json']").textContent);
  const { height, width, times, palette, quantities } = film;
  const NOTHING = 65535; // of 16 bits: no value here
  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const lut = bytes(palette);
  for (const each of quantities) each.codes = new Uint16Array(bytes(each.data).buffer);
  const find = (name) => root.querySelector(`[data-part=${name}]`);
  const [picture, curve, slider, choice, readout, play] =
    ["picture", "curve", "time", "quantity", "readout", "play"].map(find);
  const scale = Math.max(1, Math.floor(Math.min(520 / width, 420 / height)));
  picture.width = width; picture.height = height;
  picture.style.width = `${width * scale}px`; picture.style.height = `${height * scale}px`;
  curve.width = 480; curve.height = 300;
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

  function draw() {
    const quantity = shown(), frame = Number(slider.value);
    const context = picture.getContext("2d"), image = context.createImageData(width, height);
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
    context.putImageData(image, 0, 0);
    const std = quantities.find((each) => each.name === `${quantity.name}_std`);
    const bar = std ? ` ± ${text(value(std, frame, ...pixel))}` : "";
    const [row, column] = pixel.map((place) => place * film.step);
    readout.textContent = `${times[frame].toFixed(2)} s, row ${row}, column ${column}: ` +
      `${text(value(quantity, frame, ...pixel))}${bar} ${quantity.unit}   (colours ` +
      `${text(quantity.shown[0])} to ${text(quantity.shown[1])} ${quantity.unit})`;
    drawCurve(quantity, std, frame);
  }

  function drawCurve(quantity, std, frame) {
    const context = curve.getContext("2d"), [left, top, right, bottom] = [58, 22, 456, 258];
    context.clearRect(0, 0, curve.width, curve.height);
    const values = times.map((_, index) => value(quantity, index, ...pixel));
    const errors = values.map((_, index) => (std ? 2 * value(std, index, ...pixel) : 0));
    const ends = values.flatMap((here, index) => [here - (errors[index] || 0), here + (errors[index] || 0)]).filter(Number.isFinite);
    context.fillStyle = context.strokeStyle = "#1d2733";
    context.font = "12px system-ui, sans-serif";
    if (ends.length === 0) { context.fillText("no value at this pixel", left + 20, top + 40); return; }
    let [low, high] = [Math.min(...ends), Math.max(...ends)];
    if (high - low < 0.1) [low, high] = [low - 0.05, high + 0.05];
    const last = times.length - 1, span = times[last] - times[0] || 1;
    const x = (index) => left + (right - left) * (times[index] - times[0]) / span;
    const y = (here) => bottom - (bottom - top) * (here - low) / (high - low);
    context.strokeRect(left, top, right - left, bottom - top);
    for (let tick = 0; tick <= 4; tick++) {
      const here = low + (high - low) * tick / 4, moment = times[0] + span * tick / 4;
      context.textAlign = "right"; context.fillText(here.toFixed(high - low < 2 ? 2 : 1), left - 5, y(here) + 4);
      context.textAlign = "center"; context.fillText(moment.toFixed(1), left + (right - left) * tick / 4, bottom + 16);
    }
    context.fillText("time [s]", (left + right) / 2, bottom + 34);
    context.textAlign = "left"; context.fillText(`${quantity.label} [${quantity.unit}]${std ? ", two standard deviations" : ""}`, left, top - 8);
    context.fillStyle = "#1b6ca833"; context.strokeStyle = "#1b6ca8";
    values.forEach((here, index) => {
      if (Number.isFinite(here) && errors[index] > 0) {
        context.fillRect(x(index) - 1, y(here + errors[index]), Math.max(2, (right - left) / last), y(here - errors[index]) - y(here + errors[index]));
      }
    });
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
  draw();
}
