// Measures the distance between two points of the surface, and writes the command that scales a run by it.
const ruler = { on: false, ends: [] }; // ends relative to facts.origin
const OPAQUE = 0.5; // transmittance at the surface: the median depth of the rasterizer's contract
const TAP = 5; // CSS px that a pointer may move in a tap
let records, reaches; // 8 words per splat (viewer/packed_splats.py); visible radius of each splat, world units

const float16 = (h) => {
  const exponent = (h >> 10) & 31, fraction = h & 1023, sign = h & 0x8000 ? -1 : 1;
  return sign * (exponent ? (1 + fraction / 1024) * 2 ** (exponent - 15) : fraction * 2 ** -24);
};
const int16 = (word) => Math.max(((word << 16) >> 16) / 32767, -1);

function keepRecords(buffer) {
  records = new Uint32Array(buffer.slice(0, 32 * facts.splats));
  reaches = null;
}

function splatAt(i) {
  const words = records.subarray(8 * i, 8 * i + 8), mean = [...new Float32Array(records.buffer, 32 * i, 3)];
  const scales = [words[3] & 0xffff, words[3] >>> 16].map((h) => Math.exp(float16(h)));
  const q = [words[4], words[4] >>> 16, words[5], words[5] >>> 16].map(int16), length = Math.hypot(...q);
  const [w, x, y, z] = q.map((part) => part / length);
  return {
    mean, scales, opacity: Math.abs(float16(words[7] >>> 16)),
    tu: [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
    tv: [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
  };
}

function findReaches() {
  reaches = new Float32Array(facts.splats);
  for (let i = 0; i < facts.splats; ++i) {
    const { scales, opacity } = splatAt(i);
    reaches[i] = Math.sqrt(2 * Math.log(Math.max(opacity / facts.alphaMin, 1))) * Math.max(...scales);
  }
}

function surfaceAt(x, y) {
  // The surface point (relative to facts.origin) at a point of the window, or null.
  if (!reaches) findReaches();
  const s = fit(), [px, py] = [x - canvas.clientWidth / 2 + s * camera.w / 2, y - canvas.clientHeight / 2 + s * camera.h / 2];
  const across = [(px - s * camera.cx) / (s * camera.fx), (py - s * camera.cy) / (s * camera.fy)];
  const ray = plus(plus(times(camera.right, across[0]), camera.down, across[1]), camera.ahead); // depth 1
  const square = dot(ray, ray), means = new Float32Array(records.buffer), hits = [];
  const blur = (4 * (facts.lowpass + facts.mip)) / (s * Math.min(camera.fx, camera.fy)); // relative to the depth: a splat is at least this wide
  for (let i = 0; i < facts.splats; ++i) {
    const rel = [means[8 * i] - camera.eye[0], means[8 * i + 1] - camera.eye[1], means[8 * i + 2] - camera.eye[2]];
    const z = dot(rel, camera.ahead), along = dot(rel, ray);
    if (z <= facts.near || dot(rel, rel) - (along * along) / square > (reaches[i] + blur * z) ** 2) continue;
    if (isInCrop([means[8 * i], means[8 * i + 1], means[8 * i + 2]])) hits.push({ i, z, rel });
  }
  hits.sort((a, b) => a.z - b.z);
  let transmittance = 1;
  for (const { i, z, rel } of hits) {
    const [depth, alpha] = intersection(splatAt(i), rel, z, ray, across, s);
    transmittance *= 1 - alpha;
    if (transmittance < OPAQUE) return plus(camera.eye, ray, depth);
  }
  return null;
}

function mipFilter(scales, tu, tv, rel, z, s) {
  // The factor L of rule 24, from the map M of (u, v) to px: L L^T = 1 + mip^2 inverse(M) inverse(M)^T.
  const shift = (axis, f, t, scale) => (s * f * scale * (dot(t, axis) - (dot(rel, axis) / z) * dot(t, camera.ahead))) / z;
  const [a, b] = [tu, tv].map((t, i) => shift(camera.right, camera.fx, t, scales[i]));
  const [c, d] = [tu, tv].map((t, i) => shift(camera.down, camera.fy, t, scales[i])), s2 = (facts.mip / (a * d - b * c)) ** 2;
  if (!facts.mip || !Number.isFinite(s2)) return { l11: 1, l21: 0, l22: 1 };
  const l11 = Math.sqrt(1 + s2 * (b * b + d * d)), squares = a * a + b * b + c * c + d * d;
  const det = 1 + s2 * (squares + facts.mip ** 2);
  return { l11, l21: (-s2 * (a * b + c * d)) / l11, l22: Math.sqrt(det) / l11 };
}

function intersection({ scales, opacity, tu, tv }, rel, z, ray, across, s) {
  // Depth and alpha of a splat on a ray, as in splat.frag. Splats that cross the camera's plane do not count.
  const tilt = (scales[0] * dot(tu, camera.ahead)) ** 2 + (scales[1] * dot(tv, camera.ahead)) ** 2;
  if (facts.crossingCutoff ** 2 * tilt >= z * z) return [z, 0];
  const n = cross(tu, tv), onPlane = dot(n, rel) / dot(n, ray), offset = plus(times(ray, onPlane), rel, -1);
  const { l11, l21, l22 } = mipFilter(scales, tu, tv, rel, z, s), u = dot(offset, tu) / scales[0] / l11;
  const v = (dot(offset, tv) / scales[1] - l21 * u) / l22, flat = onPlane > 0 ? u * u + v * v : Infinity;
  const dx = s * camera.fx * (across[0] - dot(rel, camera.right) / z), dy = s * camera.fy * (across[1] - dot(rel, camera.down) / z);
  const round = (dx * dx + dy * dy) / facts.lowpass ** 2, depth = flat <= round ? onPlane : z;
  const alpha = (opacity / (l11 * l22)) * Math.exp(-0.5 * Math.min(flat, round));
  return [depth, depth < facts.near || alpha < facts.alphaMin ? 0 : Math.min(alpha, facts.alphaMax)];
}

// ---- distances ----
function inWorld(vector) {
  // A vector of the scene in metres east, north and up; for georeferenced runs.
  const { metres, rotation } = facts.world;
  return [0, 3, 6].map((row) => metres * dot(rotation.slice(row, row + 3), vector));
}

const rounded = (x) => Number(x.toPrecision(4)).toString();

function distanceText(a, b) {
  const vector = plus(b, a, -1);
  if (!facts.world) return { short: `${rounded(norm(vector))} units`, long: "Units of the capture; the scale is unknown." };
  const world = inWorld(vector), horizontal = Math.hypot(world[0], world[1]), sign = world[2] < 0 ? "−" : "+";
  return { short: `${rounded(norm(world))} m`, long: `Horizontal ${rounded(horizontal)} m, height ${sign}${rounded(Math.abs(world[2]))} m` };
}

const pointText = (p) => plus(p, facts.origin).map((x) => x.toFixed(digits + 1)).join(" ");

function setMeasuring(on = ruler.on) {
  ruler.on = on;
  if (!on) ruler.ends = [];
  press("measure", on);
  $("measurepanel").hidden = !on;
  canvas.style.cursor = on ? "crosshair" : "";
  const [a, b] = ruler.ends, isComplete = a && b;
  $("distance").textContent = isComplete ? distanceText(a, b).short : a ? "Click the other end." : "Click one end of a distance.";
  $("aside").textContent = isComplete ? distanceText(a, b).long : "";
  $("scalepanel").hidden = !isComplete;
  const metres = $("metres").valueAsNumber;
  $("scalecommand").value = isComplete && metres > 0 ? `gs2d survey RUN --known-distance ${pointText(a)} ${pointText(b)} ${metres}` : "";
  drawRuler();
}

function measureAt(x, y) {
  const point = surfaceAt(x, y);
  if (ruler.ends.length === 2) ruler.ends = [];
  if (point) ruler.ends.push(point);
  setMeasuring();
  if (!point) $("aside").textContent = "There is no surface at this point.";
}

function drawRuler() {
  $("ruler").style.display = ruler.on ? "" : "none";
  if (!ruler.on) return;
  $("ruler").querySelectorAll("circle").forEach((marker, i) => {
    const p = ruler.ends[i] && onScreen(ruler.ends[i]);
    marker.style.display = p && p.z > facts.near ? "" : "none";
    if (!p) return;
    marker.setAttribute("cx", p.x.toFixed(1));
    marker.setAttribute("cy", p.y.toFixed(1));
  });
  const line = ruler.ends.length === 2 && clipped(...ruler.ends), ends = line ? line.map(onScreen) : [];
  $("ruler").querySelector("path").setAttribute("d", line ? `M${ends.map(pathPoint).join("L")}` : "");
  const label = $("ruler").querySelector("text");
  label.textContent = line ? distanceText(...ruler.ends).short : "";
  if (!line) return;
  label.setAttribute("x", ((ends[0].x + ends[1].x) / 2).toFixed(1));
  label.setAttribute("y", ((ends[0].y + ends[1].y) / 2 - 8).toFixed(1));
}

function listenToTaps() {
  let start = null;
  canvas.addEventListener("pointerdown", (e) => { start = e.isPrimary ? [e.clientX, e.clientY] : null; });
  canvas.addEventListener("pointerup", (e) => {
    const isTap = start && Math.hypot(e.clientX - start[0], e.clientY - start[1]) < TAP;
    if (ruler.on && isTap && e.button === 0) measureAt(e.clientX, e.clientY);
  });
  $("measure").onclick = () => setMeasuring(!ruler.on);
  $("metres").oninput = () => setMeasuring();
  $("copyscale").onclick = () => copy("scalecommand", "copiedscale");
  setMeasuring(false);
}
