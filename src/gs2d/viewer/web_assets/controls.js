// Buttons, keys, mouse and fingers; the crop box with its numbers and handles.
const digits = clamp(3 - Math.floor(Math.log10(Math.max(radius, 1e-9))), 0, 9); // a thousandth of the subject
const crop = { on: true, isEdited: false, low: [...facts.crop.low], high: [...facts.crop.high] }; // relative to facts.origin
const NAMES = { splats: "Splats", mesh: "Mesh", textured: "Textured mesh" };

const isPressed = (id) => $(id).getAttribute("aria-pressed") === "true";
const press = (id, on) => $(id).setAttribute("aria-pressed", on);

// ---- crop ----
// The view of a photograph shows everything, so that it compares with the photograph.
const isCropped = () => crop.isEdited || (crop.on && !atPhotograph);
const isInCrop = (p) => !isCropped() || p.every((x, i) => x >= crop.low[i] && x <= crop.high[i]);
const limitText = (side, i) => (crop[side][i] + facts.origin[i]).toFixed(digits).replace(/^-(0(\.0*)?)$/, "$1");
const cropText = () => ["low", "high"].map((side) => [0, 1, 2].map((i) => limitText(side, i)).join(" ")).join(" ");

function setCrop(on) {
  crop.on = on;
  if (!on) crop.isEdited = false;
  updateCrop();
}

function editCrop(on) {
  crop.isEdited = on;
  if (on) crop.on = true;
  updateCrop();
}

function updateCrop() {
  press("crop", crop.on);
  press("editcrop", crop.isEdited);
  $("croppanel").hidden = !crop.isEdited;
  $("cropbox").style.display = crop.isEdited ? "" : "none";
  for (const input of $("croppanel").querySelectorAll("input[data-side]")) {
    if (input !== document.activeElement) input.value = limitText(input.dataset.side, +input.dataset.axis);
  }
  $("bbox").value = `--bbox ${cropText()}`;
  moved();
}

function setFace(side, i, value) {
  // A face does not pass the opposite one.
  const gap = 1e-3 * radius, other = crop[side === "low" ? "high" : "low"][i];
  crop[side][i] = side === "low" ? Math.min(value, other - gap) : Math.max(value, other + gap);
  updateCrop();
}

function resetCrop() {
  [crop.low, crop.high] = [[...facts.crop.low], [...facts.crop.high]];
  updateCrop();
}

async function copy(field, result) {
  try {
    await navigator.clipboard.writeText($(field).value);
  } catch {
    $(field).select();
    document.execCommand("copy"); // for files, which have no clipboard
  }
  $(result).textContent = "Copied";
  setTimeout(() => ($(result).textContent = ""), 2000);
}

// ---- lines and handles over the image ----
const pathPoint = (p) => `${p.x.toFixed(1)} ${p.y.toFixed(1)}`;

function onScreen(point) {
  const p = plus(point, camera.eye, -1), z = dot(p, camera.ahead), s = fit();
  const cx = canvas.clientWidth / 2 + s * (camera.cx - camera.w / 2), cy = canvas.clientHeight / 2 + s * (camera.cy - camera.h / 2);
  return { x: cx + (s * camera.fx * dot(p, camera.right)) / z, y: cy + (s * camera.fy * dot(p, camera.down)) / z, z };
}

function clipped(a, b) {
  // The part of a line in front of the near plane, or null.
  const depth = (p) => dot(plus(p, camera.eye, -1), camera.ahead), [za, zb] = [depth(a), depth(b)];
  if (za < facts.near && zb < facts.near) return null;
  const end = (p, q, zp, zq) => (zp >= facts.near ? p : plus(p, plus(q, p, -1), (facts.near - zp) / (zq - zp)));
  return [end(a, b, za, zb), end(b, a, zb, za)];
}

const faceCenter = (side, i) => crop.low.map((x, k) => (k === i ? crop[side][k] : (x + crop.high[k]) / 2));

function drawCropBox() {
  if (!crop.isEdited) return;
  const corner = (n) => [0, 1, 2].map((i) => ((n >> i) & 1 ? crop.high[i] : crop.low[i])), lines = [];
  for (let n = 0; n < 8; ++n) {
    for (let i = 0; i < 3; ++i) {
      const ends = !((n >> i) & 1) && clipped(corner(n), corner(n | (1 << i)));
      if (ends) lines.push(`M${ends.map(onScreen).map(pathPoint).join("L")}`);
    }
  }
  $("cropbox").querySelector("path").setAttribute("d", lines.join(""));
  for (const handle of $("cropbox").querySelectorAll("circle")) {
    const p = onScreen(faceCenter(handle.dataset.side, +handle.dataset.axis));
    handle.style.display = p.z > facts.near ? "" : "none";
    handle.setAttribute("cx", p.x.toFixed(1));
    handle.setAttribute("cy", p.y.toFixed(1));
  }
}

function makeHandles() {
  for (const handle of $("cropbox").querySelectorAll("circle")) {
    const { side } = handle.dataset, i = +handle.dataset.axis;
    handle.setAttribute("r", isTouch ? 15 : 9);
    handle.onpointerdown = (e) => handle.setPointerCapture(e.pointerId);
    handle.onpointermove = (e) => {
      if (!handle.hasPointerCapture(e.pointerId)) return;
      const face = faceCenter(side, i), step = 1e-3 * radius, axis = [0, 1, 2].map((k) => (k === i ? step : 0));
      const a = onScreen(face), b = onScreen(plus(face, axis)), px = [(b.x - a.x) / step, (b.y - a.y) / step];
      const square = px[0] ** 2 + px[1] ** 2;
      if (square > 1e-6) setFace(side, i, face[i] + (px[0] * (e.clientX - a.x) + px[1] * (e.clientY - a.y)) / square);
    };
  }
}

// ---- turning by itself ----
let lastSpin = 0, spinDirection = 1;
function spin() {
  const now = performance.now(), seconds = Math.min(now - lastSpin, 100) / 1000;
  lastSpin = now;
  if (!orbit(spinDirection * spinning * seconds, 0)) spinDirection = -spinDirection; // at an end of the arc
}

function setSpinning(on) {
  spinning = on ? 0.25 : 0;
  lastSpin = performance.now();
  press("spin", on);
  if (on) moved();
}

// ---- what is shown ----
function show(name) {
  shows = name;
  for (const button of $("shows").children) button.setAttribute("aria-pressed", button.dataset.show === shows);
  setKind(kind);
}

function setKind(next) {
  kind = next;
  $("kind").value = kind;
  moved();
}

function toggleFullScreen() {
  if (document.fullscreenElement) document.exitFullscreen();
  else document.documentElement.requestFullscreen?.();
}

function toggleTools(on = !document.body.classList.contains("tools")) {
  document.body.classList.toggle("tools", on);
  $("tools").setAttribute("aria-expanded", on);
}

function makeShows() {
  const buttons = ["splats", ...offer.meshes].map((name) => {
    const button = document.createElement("button");
    [button.textContent, button.dataset.show, button.onclick] = [NAMES[name], name, () => show(name)];
    return button;
  });
  $("shows").replaceChildren(...buttons);
  $("shows").hidden = buttons.length < 2;
}

function listenToPointers() {
  const fingers = new Map();
  const spread = () => {
    const [a, b] = [...fingers.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  canvas.onpointerdown = (e) => {
    canvas.setPointerCapture(e.pointerId);
    fingers.set(e.pointerId, { x: e.clientX, y: e.clientY });
    setSpinning(false);
  };
  canvas.onpointerup = canvas.onpointercancel = (e) => fingers.delete(e.pointerId);
  canvas.onpointermove = (e) => {
    const before = fingers.get(e.pointerId);
    if (!before) return;
    const [dx, dy] = [e.clientX - before.x, e.clientY - before.y], isPinch = fingers.size === 2, distance = isPinch ? spread() : 0;
    fingers.set(e.pointerId, { x: e.clientX, y: e.clientY });
    if (fingers.size > 2 || (dx === 0 && dy === 0)) return;
    if (isPinch) {
      zoom(distance / Math.max(spread(), 1));
      pan(dx / 2, dy / 2);
    } else if (e.buttons & 2 || e.shiftKey) pan(dx, dy);
    else orbit(dx * 0.006, dy * 0.006);
  };
  canvas.onwheel = (e) => {
    e.preventDefault();
    $("hint").hidden = true;
    zoom(Math.exp(0.0015 * clamp(e.deltaY, -200, 200)));
  };
  canvas.oncontextmenu = (e) => e.preventDefault();
  canvas.ondblclick = () => ruler.on || goHome();
}

function listenToButtons() {
  const turn = (dx, dy) => () => {
    setSpinning(false);
    orbit(dx, dy);
  };
  const toggleKind = (other) => () => setKind(kind === other ? 0 : other);
  const keys = {
    ArrowLeft: () => goTo(shown - 1), ArrowRight: () => goTo(shown + 1),
    a: turn(0.1, 0), d: turn(-0.1, 0), w: turn(0, 0.1), s: turn(0, -0.1),
    "+": () => zoom(0.9), "=": () => zoom(0.9), "-": () => zoom(1.1),
    h: goHome, Home: goHome, t: () => setSpinning(!spinning),
    c: () => setKind(0), n: toggleKind(1), z: toggleKind(2), x: () => setCrop(!crop.on), b: () => editCrop(!crop.isEdited),
    p: () => $("showcameras").click(), m: () => setMeasuring(!ruler.on), Escape: () => setMeasuring(false),
    f: toggleFullScreen, "?": () => $("help").showModal(),
  };
  onkeydown = (e) => {
    const isTyping = e.target.matches("input:not([type=checkbox]), select") || $("help").open;
    if (isTyping || !keys[e.key] || e.ctrlKey || e.metaKey || e.altKey) return;
    $("hint").hidden = true;
    keys[e.key]();
  };
  const actions = {
    previous: keys.ArrowLeft, next: keys.ArrowRight, home: goHome, spin: keys.t, crop: keys.x, editcrop: keys.b,
    resetcrop: resetCrop, full: toggleFullScreen, helpbutton: keys["?"], tools: () => toggleTools(),
    copybbox: () => copy("bbox", "copied"),
    showcameras: () => {
      press("showcameras", !isPressed("showcameras"));
      redraw();
    },
  };
  for (const [id, action] of Object.entries(actions)) $(id).onclick = action;
  $("kind").onchange = (e) => setKind(Number(e.target.value));
  $("free").onchange = (e) => (limited = !e.target.checked);
  for (const input of $("croppanel").querySelectorAll("input[data-side]")) {
    const { side, axis } = input.dataset;
    input.step = 10 ** (1 - digits);
    input.oninput = () => Number.isFinite(input.valueAsNumber) && setFace(side, +axis, input.valueAsNumber - facts.origin[+axis]);
    input.onblur = updateCrop;
  }
  $("full").hidden = !document.documentElement.requestFullscreen;
}

function listen() {
  addEventListener("pointerdown", () => ($("hint").hidden = true), { once: true });
  listenToPointers();
  listenToButtons();
  listenToTaps();
  makeShows();
  makeHandles();
  makeFrustums();
  onresize = moved;
  canvas.addEventListener("webglcontextlost", () => fail(Error("the graphics card was reset; reload the page")));
}
