// A grid of round metres below the map, and a bar that says how long a metre is.

const LEAST_PX = 56; // between two lines

// 1, 2 or 5 times a power of ten: the smallest that is so many pixels long.
export function roundMetres(scale, pixels) {
  const least = pixels / scale, power = 10 ** Math.floor(Math.log10(least));
  return power * [1, 2, 5, 10].find((each) => each * power >= least * 0.9999);
}

export function drawGrid(pen, projection, colour) {
  const { clientWidth: w, clientHeight: h } = projection.canvas;
  const step = roundMetres(projection.scale, LEAST_PX);
  pen.strokeStyle = colour;
  pen.lineWidth = 1;
  pen.beginPath();
  if (projection.plane === "orbit") ground(pen, projection, step, Math.max(w, h));
  else {
    const [cx, cy] = projection.flat(projection.centre);
    const reach = [w / 2 / projection.scale, h / 2 / projection.scale];
    for (let x = Math.ceil((cx - reach[0]) / step) * step; x <= cx + reach[0]; x += step) {
      const at = Math.round(w / 2 + (x - cx) * projection.scale) + 0.5;
      pen.moveTo(at, 0);
      pen.lineTo(at, h);
    }
    for (let y = Math.ceil((cy - reach[1]) / step) * step; y <= cy + reach[1]; y += step) {
      const at = Math.round(h / 2 - (y - cy) * projection.scale) + 0.5;
      pen.moveTo(0, at);
      pen.lineTo(w, at);
    }
  }
  pen.stroke();
}

// In an orbit it is the ground, z = 0, around what is in the middle.
function ground(pen, projection, step, size) {
  const lines = Math.ceil(size / 2 / projection.scale / step);
  const [x, y] = [0, 1].map((i) => Math.round(projection.centre[i] / step) * step);
  const reach = lines * step;
  for (let n = -lines; n <= lines; n += 1) {
    for (const [from, to] of [[[x + n * step, y - reach, 0], [x + n * step, y + reach, 0]], [[x - reach, y + n * step, 0], [x + reach, y + n * step, 0]]]) {
      pen.moveTo(...projection.pixelOf(from));
      pen.lineTo(...projection.pixelOf(to));
    }
  }
}

export function drawScale(pen, projection, ink) {
  const metres = roundMetres(projection.scale, 90), length = metres * projection.scale;
  const y = projection.canvas.clientHeight - 16;
  pen.fillStyle = "#ffffffd0";
  pen.fillRect(8, y - 22, length + 16, 32);
  pen.strokeStyle = pen.fillStyle = ink;
  pen.lineWidth = 1.5;
  pen.beginPath();
  pen.moveTo(16, y - 5);
  pen.lineTo(16, y);
  pen.lineTo(16 + length, y);
  pen.lineTo(16 + length, y - 5);
  pen.stroke();
  pen.font = "12px system-ui, sans-serif";
  pen.textAlign = "center";
  pen.fillText(metres >= 1000 ? `${metres / 1000} km` : metres >= 1 ? `${metres} m` : `${Number((metres * 100).toPrecision(2))} cm`, 16 + length / 2, y - 7);
}
