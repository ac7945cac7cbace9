// Draws the splats of this page as gs2d does: discs met by rays, back to front, by WebGL 2. No network, no libraries.
"use strict";
const $ = (id) => document.getElementById(id);
const facts = JSON.parse($("facts").textContent);
const TEXELS = 2048; // a row of the textures

// ---- small vectors; matrices are rows, world to camera ----
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const plus = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const times = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => times(a, 1 / Math.hypot(...a));
const turned = (v, axis, angle) => {
  const c = Math.cos(angle), s = Math.sin(angle);
  return plus(plus(times(v, c), cross(axis, v), s), axis, dot(axis, v) * (1 - c));
};

async function unpacked() {
  const text = $("splats").textContent.trim();
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, id] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, $(id).textContent.trim());
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) throw Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS) && !gl.isContextLost()) throw Error(gl.getProgramInfoLog(made));
  const at = {};
  for (let i = 0; i < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); ++i) {
    const name = gl.getActiveUniform(made, i).name.replace("[0]", "");
    at[name] = gl.getUniformLocation(made, name);
  }
  return { made, at };
}

function table(gl, buffer, begin, texels) {
  // Words as a texture of unsigned integers, filled up to whole rows.
  const height = Math.max(1, Math.ceil(texels / TEXELS)), words = new Uint32Array(4 * TEXELS * height);
  words.set(new Uint32Array(buffer, begin, 4 * texels));
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32UI, TEXELS, height, 0, gl.RGBA_INTEGER, gl.UNSIGNED_INT, words);
  return texture;
}

// ---- where the visitor is: right, down, ahead (unit, world), eye, and a lens in px of a picture of w x h ----
const start = (i) => {
  const c = facts.cameras[i], [right, down, ahead] = [c.R.slice(0, 3), c.R.slice(3, 6), c.R.slice(6, 9)];
  const eye = times(plus(plus(times(right, c.t[0]), down, c.t[1]), ahead, c.t[2]), -1);
  return { right, down, ahead, eye, w: c.w, h: c.h, fx: c.fx, fy: c.fy, cx: c.cx, cy: c.cy };
};
let shown = 0, here, target, kind = 0;

function goTo(i) {
  shown = (i + facts.cameras.length) % facts.cameras.length;
  here = start(shown);
  const reach = Math.max(dot(plus(facts.focus, here.eye, -1), here.ahead), 0.1 * facts.unit);
  target = plus(here.eye, here.ahead, reach);
  $("view").textContent = facts.cameras[shown].name;
  touched();
}

function orbit(dx, dy) {
  const swing = (axis, angle) => {
    here.eye = plus(target, turned(plus(here.eye, target, -1), axis, angle));
    for (const name of ["right", "down", "ahead"]) here[name] = unit(turned(here[name], axis, angle));
  };
  swing(facts.up, dot(facts.up, here.down) > 0 ? dx : -dx);
  const steep = (ahead) => Math.abs(dot(ahead, facts.up)), next = turned(here.ahead, here.right, -dy);
  if (steep(next) < 0.995 || steep(next) < steep(here.ahead)) swing(here.right, -dy); // beyond, all would turn round
  touched();
}

function pan(dx, dy) {
  const reach = Math.hypot(...plus(target, here.eye, -1)) / here.fx / fit();
  const move = plus(times(here.right, -dx * reach), here.down, -dy * reach);
  here.eye = plus(here.eye, move);
  target = plus(target, move);
  touched();
}

function zoom(factor) {
  const reach = Math.hypot(...plus(target, here.eye, -1));
  const least = 0.02 * facts.unit, next = Math.min(Math.max(reach * factor, least), 50 * facts.unit);
  here.eye = plus(target, here.ahead, -next);
  touched();
}

// ---- drawing ----
const canvas = $("canvas");
const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, powerPreference: "high-performance" });
let splatProgram, finalProgram, splatTable, shTable, orderBuffer, frameBuffer, picture, pictureSize = "";
let count = 0, drawn = 0, asked = 0, waiting = false, dirty = false, moving = 0, fine = 1, coarse = 1;
const worker = new Worker(URL.createObjectURL(new Blob([$("sorter").textContent], { type: "text/javascript" })));

const fit = () => Math.min(canvas.clientWidth / here.w, canvas.clientHeight / here.h); // CSS px of a px of the photograph

function touched() {
  moving = performance.now();
  if (!dirty) requestAnimationFrame(frame);
  dirty = true;
}

worker.onmessage = ({ data }) => {
  waiting = false;
  count = data.order.length;
  gl.bindBuffer(gl.ARRAY_BUFFER, orderBuffer);
  gl.bufferData(gl.ARRAY_BUFFER, data.order, gl.DYNAMIC_DRAW);
  drawn = data.number;
  if (!dirty) requestAnimationFrame(frame);
  dirty = true;
};

function sort() {
  if (waiting) return;
  waiting = true;
  worker.postMessage({ ahead: [...here.ahead, -dot(here.ahead, here.eye)], near: facts.near, number: asked });
}

function sized(width, height) {
  if (pictureSize === `${width}x${height}`) return;
  pictureSize = `${width}x${height}`;
  gl.bindTexture(gl.TEXTURE_2D, picture);
  const deep = gl.getExtension("EXT_color_buffer_half_float") || gl.getExtension("EXT_color_buffer_float");
  const [inside, type] = deep ? [gl.RGBA16F, gl.HALF_FLOAT] : [gl.RGBA8, gl.UNSIGNED_BYTE];
  gl.texImage2D(gl.TEXTURE_2D, 0, inside, width, height, 0, gl.RGBA, type, null);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.LINEAR);
  for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
  gl.bindFramebuffer(gl.FRAMEBUFFER, frameBuffer);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, picture, 0);
}

let last = "";
function frame() {
  dirty = false;
  const still = performance.now() - moving > 250, ratio = Math.min(devicePixelRatio || 1, 2);
  const [W, H] = [canvas.clientWidth, canvas.clientHeight].map((side) => Math.max(1, Math.round(side * ratio)));
  if (canvas.width !== W || canvas.height !== H) [canvas.width, canvas.height] = [W, H];
  const state = JSON.stringify([here.ahead, here.eye]);
  if (state !== last) [last, asked] = [state, asked + 1];
  if (drawn !== asked) sort();
  const scale = still ? fine : coarse, width = Math.max(1, Math.round(W * scale)), height = Math.max(1, Math.round(H * scale));
  const began = performance.now();
  sized(width, height);
  render(width, height);
  if (!still) {
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4)); // waits: how long does a picture take here?
    const took = performance.now() - began;
    coarse = took > 60 ? Math.max(0.25, coarse * 0.8) : took < 25 ? Math.min(1, coarse * 1.1) : coarse;
    setTimeout(() => { if (!dirty) requestAnimationFrame(frame); dirty = true; }, 300); // sharp again, once at rest
  }
  document.body.dataset.drawn = drawn === asked && still ? "still" : "moving";
}

function render(width, height) {
  const s = fit() * (width / canvas.clientWidth), { at } = splatProgram;
  const cx = width / 2 + s * (here.cx - here.w / 2), cy = height / 2 + s * (here.cy - here.h / 2);
  gl.bindFramebuffer(gl.FRAMEBUFFER, frameBuffer);
  gl.viewport(0, 0, width, height);
  gl.clearColor(0, 0, 0, 0);
  gl.clear(gl.COLOR_BUFFER_BIT);
  gl.useProgram(splatProgram.made);
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  const { right, down, ahead, eye } = here;
  gl.uniformMatrix3fv(at.turn, true, [...right, ...down, ...ahead]);
  gl.uniform3f(at.shift, -dot(right, eye), -dot(down, eye), -dot(ahead, eye));
  gl.uniform3f(at.eye, ...eye);
  gl.uniform4f(at.lens, s * here.fx, s * here.fy, cx, cy);
  gl.uniform2f(at.size, width, height);
  gl.uniform1f(at.height, height);
  gl.uniform1i(at.kind, kind);
  [splatTable, shTable].forEach((texture, i) => {
    gl.activeTexture(gl.TEXTURE0 + i);
    gl.bindTexture(gl.TEXTURE_2D, texture);
  });
  gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  gl.viewport(0, 0, canvas.width, canvas.height);
  gl.disable(gl.BLEND);
  gl.useProgram(finalProgram.made);
  gl.activeTexture(gl.TEXTURE0);
  gl.bindTexture(gl.TEXTURE_2D, picture);
  gl.uniform2f(finalProgram.at.canvas, canvas.width, canvas.height);
  gl.uniform1i(finalProgram.at.kind, kind);
  gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
}

async function begin() {
  if (!gl) throw Error("this browser has no WebGL 2");
  const buffer = await unpacked(), n = facts.splats;
  [splatProgram, finalProgram] = [program(gl, "splat-vert", "splat-frag"), program(gl, "final-vert", "final-frag")];
  splatTable = table(gl, buffer, 0, 2 * n);
  shTable = table(gl, buffer, 32 * n, facts.stored * n);
  const words = new Float32Array(buffer, 0, 8 * n), means = new Float32Array(3 * n);
  for (let i = 0; i < n; ++i) means.set(words.subarray(8 * i, 8 * i + 3), 3 * i);
  worker.postMessage({ means }, [means.buffer]);
  [orderBuffer, frameBuffer, picture] = [gl.createBuffer(), gl.createFramebuffer(), gl.createTexture()];
  gl.bindBuffer(gl.ARRAY_BUFFER, orderBuffer);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
  gl.vertexAttribDivisor(0, 1);
  gl.useProgram(splatProgram.made);
  const { at } = splatProgram;
  gl.uniform1i(at.splats, 0);
  gl.uniform1i(at.harmonics, 1);
  for (const name of ["near", "alphaMin", "alphaMax", "lowpass", "crossingCutoff"]) gl.uniform1f(at[name], facts[name]);
  for (const name of ["degree", "stored", "crossing"]) gl.uniform1i(at[name], facts[name]);
  gl.uniform1fv(at.scales, facts.scales);
  gl.useProgram(finalProgram.made);
  gl.uniform3f(finalProgram.at.background, ...facts.background);
  listen();
  goTo(Number(new URLSearchParams(location.hash.slice(1)).get("view")) || 0);
  $("wait").remove();
}

function listen() {
  const fingers = new Map();
  const spread = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a.x - b.x, a.y - b.y); };
  canvas.onpointerdown = (e) => { canvas.setPointerCapture(e.pointerId); fingers.set(e.pointerId, { x: e.clientX, y: e.clientY }); };
  canvas.onpointerup = canvas.onpointercancel = (e) => fingers.delete(e.pointerId);
  canvas.onpointermove = (e) => {
    const before = fingers.get(e.pointerId);
    if (!before) return;
    const [dx, dy] = [e.clientX - before.x, e.clientY - before.y], two = fingers.size === 2, apart = two ? spread() : 0;
    fingers.set(e.pointerId, { x: e.clientX, y: e.clientY });
    if (two) { zoom(apart / Math.max(spread(), 1)); pan(dx / 2, dy / 2); }
    else if (e.buttons & 2 || e.shiftKey) pan(dx, dy);
    else orbit(dx * 0.006, dy * 0.006);
  };
  canvas.onwheel = (e) => { e.preventDefault(); zoom(Math.exp(0.0015 * Math.max(-200, Math.min(200, e.deltaY)))); };
  canvas.oncontextmenu = (e) => e.preventDefault();
  const keys = { ArrowLeft: () => goTo(shown - 1), ArrowRight: () => goTo(shown + 1), n: () => show(1 - kind), "+": () => zoom(0.9), "-": () => zoom(1.1) };
  onkeydown = (e) => keys[e.key] && !e.ctrlKey && !e.metaKey && keys[e.key]();
  onresize = touched;
  $("before").onclick = keys.ArrowLeft;
  $("after").onclick = keys.ArrowRight;
  $("kind").onclick = keys.n;
  canvas.addEventListener("webglcontextlost", () => failed(Error("the graphics card gave up; reload the page")));
}

function show(next) {
  kind = next;
  $("kind").textContent = kind ? "colours" : "normals";
  touched();
}

function failed(error) {
  document.body.dataset.drawn = "failed";
  const line = document.createElement("p");
  line.textContent = `Cannot draw here: ${error.message}`;
  line.id = "failed";
  document.body.append(line);
}

begin().catch(failed);
