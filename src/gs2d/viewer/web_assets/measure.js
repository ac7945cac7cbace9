// Measuring: two places on the surface, the distance between them, and the command that gives a run its true size.
const ruler = { on: false, ends: [] }; // ends relative to facts.origin
const SURE = 0.5; // of a pixel's light that must be stopped: the median depth of the rasterizer's contract
const TAP = 5; // CSS px that a finger may move in a tap
let records, reaches; // 8 words a splat (viewer/web.py); how far each can be seen from its centre, world units

const half = (h) => {
  const power = (h >> 10) & 31, part = h & 1023, sign = h & 0x8000 ? -1 : 1;
  return sign * (power ? (1 + part / 1024) * 2 ** (power - 15) : part * 2 ** -24);
};
const short = (word) => Math.max(((word << 16) >> 16) / 32767, -1);

function keepRecords(buffer) {
  records = new Uint32Array(buffer.slice(0, 32 * facts.splats));
  reaches = null;
}

function splatAt(i) {
  const words = records.subarray(8 * i, 8 * i + 8), mean = [...new Float32Array(records.buffer, 32 * i, 3)];
  const scales = [words[3] & 0xffff, words[3] >>> 16].map((h) => Math.exp(half(h)));
  const q = [words[4], words[4] >>> 16, words[5], words[5] >>> 16].map(short), length = Math.hypot(...q);
  const [w, x, y, z] = q.map((part) => part / length);
  return {
    mean, scales, opacity: half(words[7] >>> 16),
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
  // The place (relative to facts.origin) where half of the light of a point of the window is stopped, or null.
  if (!reaches) findReaches();
  const s = fit(), [px, py] = [x - canvas.clientWidth / 2 + s * here.w / 2, y - canvas.clientHeight / 2 + s * here.h / 2];
  const across = [(px - s * here.cx) / (s * here.fx), (py - s * here.cy) / (s * here.fy)];
  const ray = plus(plus(times(here.right, across[0]), here.down, across[1]), here.ahead); // of depth 1
  const square = dot(ray, ray), means = new Float32Array(records.buffer), met = [];
  const blur = (4 * facts.lowpass) / (s * Math.min(here.fx, here.fy)); // of the depth: no pixel is seen farther off
  for (let i = 0; i < facts.splats; ++i) {
    const rel = [means[8 * i] - here.eye[0], means[8 * i + 1] - here.eye[1], means[8 * i + 2] - here.eye[2]];
    const z = dot(rel, here.ahead), along = dot(rel, ray);
    if (z <= facts.near || dot(rel, rel) - (along * along) / square > (reaches[i] + blur * z) ** 2) continue;
    if (inBox([means[8 * i], means[8 * i + 1], means[8 * i + 2]])) met.push({ i, z, rel });
  }
  met.sort((a, b) => a.z - b.z);
  let light = 1;
  for (const { i, z, rel } of met) {
    const [depth, alpha] = meeting(splatAt(i), rel, z, ray, across, s);
    light *= 1 - alpha;
    if (light < SURE) return plus(here.eye, ray, depth);
  }
  return null;
}

function meeting({ scales, opacity, tu, tv }, rel, z, ray, across, s) {
  // Depth and alpha of a splat on a ray, as splat.frag has them. One that crosses the camera's plane is no surface.
  const tilt = (scales[0] * dot(tu, here.ahead)) ** 2 + (scales[1] * dot(tv, here.ahead)) ** 2;
  if (facts.crossingCutoff ** 2 * tilt >= z * z) return [z, 0];
  const n = cross(tu, tv), onPlane = dot(n, rel) / dot(n, ray), hit = plus(times(ray, onPlane), rel, -1);
  const flat = onPlane > 0 ? (dot(hit, tu) / scales[0]) ** 2 + (dot(hit, tv) / scales[1]) ** 2 : Infinity;
  const dx = s * here.fx * (across[0] - dot(rel, here.right) / z), dy = s * here.fy * (across[1] - dot(rel, here.down) / z);
  const round = (dx * dx + dy * dy) / facts.lowpass ** 2, depth = flat <= round ? onPlane : z;
  const alpha = opacity * Math.exp(-0.5 * Math.min(flat, round));
  return [depth, depth < facts.near || alpha < facts.alphaMin ? 0 : Math.min(alpha, facts.alphaMax)];
}

// ---- what it is in the world ----
function inWorld(way) {
  // A way between two places in metres east, north and up, where the run knows its place.
  const { metres, rotation } = facts.world;
  return [0, 3, 6].map((row) => metres * dot(rotation.slice(row, row + 3), way));
}

const plain = (x) => Number(x.toPrecision(4)).toString();

function distanceTold(a, b) {
  const way = plus(b, a, -1);
  if (!facts.world) return { short: `${plain(Math.hypot(...way))} units`, long: "of the capture, whose size is not known" };
  const [east, north, up] = inWorld(way), level = Math.hypot(east, north);
  return { short: `${plain(Math.hypot(east, north, up))} m`, long: `level ${plain(level)} m, height ${up < 0 ? "−" : "+"}${plain(Math.abs(up))} m` };
}

const placeTold = (p) => plus(p, facts.origin).map((x) => x.toFixed(digits + 1)).join(" ");

function measuring(on = ruler.on) {
  ruler.on = on;
  if (!on) ruler.ends = [];
  $("measure").setAttribute("aria-pressed", on);
  $("measurepanel").hidden = !on;
  canvas.style.cursor = on ? "crosshair" : "";
  const [a, b] = ruler.ends, whole = a && b;
  $("distance").textContent = whole ? distanceTold(a, b).short : a ? "and now the other end" : "click one end";
  $("aside").textContent = whole ? distanceTold(a, b).long : "";
  $("known").hidden = !whole;
  const metres = $("truly").valueAsNumber;
  $("knowncommand").value = whole && metres > 0 ? `gs2d georeference RUN --known-distance ${placeTold(a)} ${placeTold(b)} ${metres}` : "";
  drawRuler();
}

function measureAt(x, y) {
  const place = surfaceAt(x, y);
  if (ruler.ends.length === 2) ruler.ends = [];
  if (place) ruler.ends.push(place);
  measuring();
  if (!place) $("aside").textContent = "nothing solid there";
}

function drawRuler() {
  const line = $("ruler"), marks = line.querySelectorAll("circle"), cut = ruler.ends.length === 2 && cutAtNear(...ruler.ends);
  line.style.display = ruler.on ? "" : "none";
  if (!ruler.on || !here) return;
  marks.forEach((mark, i) => {
    const p = ruler.ends[i] && onScreen(ruler.ends[i]);
    mark.style.display = p && p.z > facts.near ? "" : "none";
    if (p) { mark.setAttribute("cx", p.x.toFixed(1)); mark.setAttribute("cy", p.y.toFixed(1)); }
  });
  const ends = cut ? cut.map(onScreen) : [];
  line.querySelector("path").setAttribute("d", cut ? "M" + ends.map((p) => `${p.x.toFixed(1)} ${p.y.toFixed(1)}`).join("L") : "");
  const label = line.querySelector("text");
  label.textContent = cut ? distanceTold(...ruler.ends).short : "";
  if (cut) { label.setAttribute("x", ((ends[0].x + ends[1].x) / 2).toFixed(1)); label.setAttribute("y", ((ends[0].y + ends[1].y) / 2 - 8).toFixed(1)); }
}

function listenForTaps() {
  let from = null;
  canvas.addEventListener("pointerdown", (e) => { from = e.isPrimary ? [e.clientX, e.clientY] : null; });
  canvas.addEventListener("pointerup", (e) => {
    const near = from && Math.hypot(e.clientX - from[0], e.clientY - from[1]) < TAP;
    if (ruler.on && near && e.button === 0) measureAt(e.clientX, e.clientY);
  });
  $("measure").onclick = () => measuring(!ruler.on);
  $("truly").oninput = () => measuring();
  $("copyknown").onclick = () => copied("knowncommand", "copiedknown");
  measuring(false);
}
