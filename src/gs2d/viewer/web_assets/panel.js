// What the visitor presses: buttons, keys, fingers; the clip box with its numbers and handles; help.
const digits = clamp(3 - Math.floor(Math.log10(Math.max(radius, 1e-9))), 0, 9); // a thousandth of the subject
const box = { on: false, low: [...facts.subject.low], high: [...facts.subject.high] }; // relative to facts.origin
const svg = $("lines");

const inBox = (p) => !box.on || p.every((x, i) => x >= box.low[i] && x <= box.high[i]);
const number = (side, i) => (box[side][i] + facts.origin[i]).toFixed(digits).replace(/^-(0(\.0*)?)$/, "$1");
const numbers = () => ["low", "high"].map((side) => [0, 1, 2].map((i) => number(side, i)).join(" ")).join(" ");

function boxed(on = box.on) {
  box.on = on;
  $("boxpanel").hidden = !on;
  svg.style.display = on ? "" : "none";
  $("box").setAttribute("aria-pressed", on);
  for (const input of $("boxpanel").querySelectorAll("input[data-side]")) {
    if (input !== document.activeElement) input.value = number(input.dataset.side, +input.dataset.axis);
  }
  $("bbox").value = `--bbox ${numbers()}`;
  if (here) overlay();
  touched();
}

function setFace(side, i, value) {
  // A face never passes the one that lies opposite.
  const thin = 1e-3 * radius, other = box[side === "low" ? "high" : "low"][i];
  box[side][i] = side === "low" ? Math.min(value, other - thin) : Math.max(value, other + thin);
  boxed();
}

async function copied(field, told) {
  try {
    await navigator.clipboard.writeText($(field).value);
  } catch {
    $(field).select();
    document.execCommand("copy"); // where the clipboard is only for pages of servers
  }
  $(told).textContent = "copied";
  setTimeout(() => ($(told).textContent = ""), 2000);
}

// ---- lines and handles over the picture ----
function onScreen(point) {
  const p = plus(point, here.eye, -1), z = dot(p, here.ahead), s = fit();
  const [cx, cy] = [canvas.clientWidth / 2 + s * (here.cx - here.w / 2), canvas.clientHeight / 2 + s * (here.cy - here.h / 2)];
  return { x: cx + (s * here.fx * dot(p, here.right)) / z, y: cy + (s * here.fy * dot(p, here.down)) / z, z };
}

function cutAtNear(a, b) {
  // The part of a line in front of the camera, or nothing.
  const least = facts.near, depth = (p) => dot(plus(p, here.eye, -1), here.ahead);
  const [za, zb] = [depth(a), depth(b)];
  if (za < least && zb < least) return null;
  const meet = (p, q, zp, zq) => (zp >= least ? p : plus(p, plus(q, p, -1), (least - zp) / (zq - zp)));
  return [meet(a, b, za, zb), meet(b, a, zb, za)];
}

const faceCenter = (side, i) => box.low.map((x, k) => (k === i ? box[side][k] : (x + box.high[k]) / 2));

function overlay() {
  if (!box.on) return;
  const corner = (n) => [0, 1, 2].map((i) => ((n >> i) & 1 ? box.high[i] : box.low[i]));
  const parts = [];
  for (let n = 0; n < 8; ++n) {
    for (let i = 0; i < 3; ++i) {
      const ends = !((n >> i) & 1) && cutAtNear(corner(n), corner(n | (1 << i)));
      if (ends) parts.push("M" + ends.map(onScreen).map((p) => `${p.x.toFixed(1)} ${p.y.toFixed(1)}`).join("L"));
    }
  }
  svg.querySelector("path").setAttribute("d", parts.join(""));
  for (const handle of svg.querySelectorAll("circle")) {
    const p = onScreen(faceCenter(handle.dataset.side, +handle.dataset.axis));
    handle.style.display = p.z > facts.near ? "" : "none";
    handle.setAttribute("cx", p.x.toFixed(1));
    handle.setAttribute("cy", p.y.toFixed(1));
  }
}

function makeHandles() {
  for (const handle of svg.querySelectorAll("circle")) {
    const { side } = handle.dataset, i = +handle.dataset.axis;
    handle.setAttribute("r", matchMedia("(pointer: coarse)").matches ? 15 : 9);
    handle.onpointerdown = (e) => handle.setPointerCapture(e.pointerId);
    handle.onpointermove = (e) => {
      if (!handle.hasPointerCapture(e.pointerId)) return;
      const at = faceCenter(side, i), little = 1e-3 * radius, axis = [0, 1, 2].map((k) => (k === i ? little : 0));
      const a = onScreen(at), b = onScreen(plus(at, axis)), way = [(b.x - a.x) / little, (b.y - a.y) / little];
      const square = way[0] ** 2 + way[1] ** 2;
      if (square > 1e-6) setFace(side, i, at[i] + (way[0] * (e.clientX - a.x) + way[1] * (e.clientY - a.y)) / square);
    };
  }
}

// ---- turning by itself ----
let spun = 0, way = 1;
function spin() {
  const now = performance.now(), dt = Math.min(now - spun, 100);
  spun = now;
  if (!orbit((way * spinning * dt) / 1000, 0)) way = -way; // at an end of the arc: back
}

function turnItself(on) {
  spinning = on ? 0.25 : 0; // radians a second
  spun = performance.now();
  $("spin").setAttribute("aria-pressed", on);
  $("spin").textContent = on ? "stop" : "turn";
  touched();
}

function show(next) {
  kind = next;
  for (const button of document.querySelectorAll("[data-kind]")) button.setAttribute("aria-pressed", +button.dataset.kind === kind);
  touched();
}

function fullScreen() {
  if (document.fullscreenElement) document.exitFullscreen();
  else document.documentElement.requestFullscreen?.();
}

function listen() {
  const fingers = new Map();
  const spread = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a.x - b.x, a.y - b.y); };
  canvas.onpointerdown = (e) => {
    canvas.setPointerCapture(e.pointerId);
    fingers.set(e.pointerId, { x: e.clientX, y: e.clientY });
    turnItself(false);
    $("hint").hidden = true;
  };
  canvas.onpointerup = canvas.onpointercancel = (e) => fingers.delete(e.pointerId);
  canvas.onpointermove = (e) => {
    const before = fingers.get(e.pointerId);
    if (!before) return;
    const [dx, dy] = [e.clientX - before.x, e.clientY - before.y], two = fingers.size === 2, apart = two ? spread() : 0;
    fingers.set(e.pointerId, { x: e.clientX, y: e.clientY });
    if (two) { zoom(apart / Math.max(spread(), 1)); pan(dx / 2, dy / 2); }
    else if (fingers.size > 2) return;
    else if (e.buttons & 2 || e.shiftKey) pan(dx, dy);
    else orbit(dx * 0.006, dy * 0.006);
  };
  canvas.onwheel = (e) => { e.preventDefault(); $("hint").hidden = true; zoom(Math.exp(0.0015 * clamp(e.deltaY, -200, 200))); };
  canvas.oncontextmenu = (e) => e.preventDefault();
  canvas.ondblclick = () => ruler.on || home();
  const turn = (dx, dy) => () => { turnItself(false); orbit(dx, dy); };
  const keys = {
    ArrowLeft: () => goTo(shown - 1), ArrowRight: () => goTo(shown + 1),
    a: turn(0.1, 0), d: turn(-0.1, 0), w: turn(0, 0.1), s: turn(0, -0.1),
    h: home, Home: home, t: () => turnItself(!spinning),
    c: () => show(0), n: () => show(kind === 1 ? 0 : 1), z: () => show(kind === 2 ? 0 : 2),
    b: () => boxed(!box.on), m: () => measuring(!ruler.on), Escape: () => measuring(false), f: fullScreen, "?": () => $("help").showModal(),
    "+": () => zoom(0.9), "=": () => zoom(0.9), "-": () => zoom(1.1),
  };
  onkeydown = (e) => {
    const typing = e.target.matches("input:not([type=checkbox])") || $("help").open;
    if (!typing && keys[e.key] && !e.ctrlKey && !e.metaKey && !e.altKey) {
      $("hint").hidden = true;
      keys[e.key]();
    }
  };
  onresize = touched;
  const press = { before: keys.ArrowLeft, after: keys.ArrowRight, home, spin: keys.t, box: keys.b, full: fullScreen, more: keys["?"], copy: () => copied("bbox", "copied") };
  for (const [id, act] of Object.entries(press)) $(id).onclick = act;
  for (const button of document.querySelectorAll("[data-kind]")) button.onclick = () => show(+button.dataset.kind);
  $("subjectbox").onclick = () => { Object.assign(box, { low: [...facts.subject.low], high: [...facts.subject.high] }); boxed(); };
  $("free").onchange = (e) => (limited = !e.target.checked);
  for (const input of $("boxpanel").querySelectorAll("input[data-side]")) {
    const { side, axis } = input.dataset;
    input.step = 10 ** (1 - digits);
    input.oninput = () => Number.isFinite(input.valueAsNumber) && setFace(side, +axis, input.valueAsNumber - facts.origin[+axis]);
    input.onblur = () => boxed();
  }
  if (!document.documentElement.requestFullscreen) $("full").hidden = true;
  makeHandles();
  listenForTaps();
  boxed(false);
  turnItself(false);
  canvas.addEventListener("webglcontextlost", () => failed(Error("the graphics card gave up; reload the page")));
}

