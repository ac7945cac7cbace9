// Draws the splats of this page as gs2d does: discs met by rays, back to front, by WebGL 2. No network, no libraries.
const TEXELS = 2048; // a row of the textures

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

// ---- drawing ----
const canvas = $("canvas");
const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, powerPreference: "high-performance" });
let splatProgram, finalProgram, splatTable, shTable, orderBuffer, frameBuffer, picture, pictureSize = "";
let range = [0, 1], fixed, sample; // depths at the ends of the scale, those that were asked for; some of the means
let count = 0, drawn = 0, asked = 0, waiting = false, dirty = false, moving = 0, fine = 1, coarse = 1;
const worker = new Worker(URL.createObjectURL(new Blob([$("sorter").textContent], { type: "text/javascript" })));

const fit = () => Math.min(canvas.clientWidth / here.w, canvas.clientHeight / here.h); // CSS px of a px of the photograph

function touched() {
  moving = performance.now();
  document.body.dataset.drawn = "moving";
  redraw();
}

function redraw() {
  if (!dirty) requestAnimationFrame(frame);
  dirty = true;
}

worker.onmessage = ({ data }) => {
  waiting = false;
  count = data.order.length;
  gl.bindBuffer(gl.ARRAY_BUFFER, orderBuffer);
  gl.bufferData(gl.ARRAY_BUFFER, data.order, gl.DYNAMIC_DRAW);
  drawn = data.number;
  redraw();
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
  overlay();
  drawRuler();
  if (facts.served) drawServed();
  if (!still) {
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4)); // waits: how long does a picture take here?
    const took = performance.now() - began;
    coarse = took > 60 ? Math.max(0.25, coarse * 0.8) : took < 25 ? Math.min(1, coarse * 1.1) : coarse;
    setTimeout(redraw, 300); // sharp again, once at rest
  }
  told();
  if (spinning) spin();
  document.body.dataset.drawn = drawn === asked && still ? "still" : "moving";
}

function depths() {
  // Nearest and farthest depth worth a colour: most of what lies in the picture.
  const found = [];
  for (let i = 0; i < sample.length; i += 3) {
    const mean = [sample[i], sample[i + 1], sample[i + 2]];
    if (inPicture(here, mean) && inBox(mean)) found.push(dot(plus(mean, here.eye, -1), here.ahead));
  }
  found.sort((a, b) => a - b);
  const at = (share) => found[Math.round(share * (found.length - 1))];
  return found.length > 9 && at(0.97) > at(0.03) ? [at(0.03), at(0.97)] : [facts.near, facts.near + 2 * facts.unit];
}

function aim({ made, at }, width, height) {
  // Uses a program, with the camera and the clip box for a picture of that size.
  const s = fit() * (width / canvas.clientWidth), { right, down, ahead, eye } = here;
  const cx = width / 2 + s * (here.cx - here.w / 2), cy = height / 2 + s * (here.cy - here.h / 2);
  gl.useProgram(made);
  gl.uniformMatrix3fv(at.turn, true, [...right, ...down, ...ahead]);
  gl.uniform3f(at.shift, -dot(right, eye), -dot(down, eye), -dot(ahead, eye));
  gl.uniform4f(at.lens, s * here.fx, s * here.fy, cx, cy);
  gl.uniform2f(at.size, width, height);
  gl.uniform3f(at.boxLow, ...(box.on ? box.low : [-1e30, -1e30, -1e30]));
  gl.uniform3f(at.boxHigh, ...(box.on ? box.high : [1e30, 1e30, 1e30]));
}

function render(width, height) {
  if (kind === 3) return drawMesh();
  const { at } = splatProgram;
  gl.bindFramebuffer(gl.FRAMEBUFFER, frameBuffer);
  gl.viewport(0, 0, width, height);
  gl.clearColor(0, 0, 0, 0);
  gl.clear(gl.COLOR_BUFFER_BIT);
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  aim(splatProgram, width, height);
  gl.uniform3f(at.eye, ...here.eye);
  gl.uniform1f(at.height, height);
  gl.uniform1i(at.kind, kind);
  if (kind === 2) range = fixed || depths();
  gl.uniform2f(at.range, ...range);
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

function load(buffer) {
  // Takes the splats that `facts` describes.
  const n = facts.splats, { at } = splatProgram;
  gl.deleteTexture(splatTable || null);
  gl.deleteTexture(shTable || null);
  splatTable = table(gl, buffer, 0, 2 * n);
  shTable = table(gl, buffer, 32 * n, facts.stored * n);
  keepRecords(buffer);
  const words = new Float32Array(buffer, 0, 8 * n), means = new Float32Array(3 * n);
  for (let i = 0; i < n; ++i) means.set(words.subarray(8 * i, 8 * i + 3), 3 * i);
  const every = Math.max(1, Math.floor(n / 4000));
  sample = Float32Array.from({ length: 3 * Math.floor(n / every) }, (_, i) => means[3 * every * Math.floor(i / 3) + (i % 3)]);
  worker.postMessage({ means }, [means.buffer]);
  gl.useProgram(splatProgram.made);
  for (const name of ["degree", "stored"]) gl.uniform1i(at[name], facts[name]);
  gl.uniform1fv(at.scales, facts.scales);
  $("count").textContent = n.toLocaleString("en");
  last = ""; // sorted anew
}

async function begin() {
  if (!gl) throw Error("this browser has no WebGL 2");
  const buffer = facts.served ? new ArrayBuffer(0) : await unpacked();
  [splatProgram, finalProgram] = [program(gl, "splat-vert", "splat-frag"), program(gl, "final-vert", "final-frag")];
  load(buffer);
  [orderBuffer, frameBuffer, picture] = [gl.createBuffer(), gl.createFramebuffer(), gl.createTexture()];
  gl.bindBuffer(gl.ARRAY_BUFFER, orderBuffer);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
  gl.vertexAttribDivisor(0, 1);
  const { at } = splatProgram;
  gl.uniform1i(at.splats, 0);
  gl.uniform1i(at.harmonics, 1);
  for (const name of ["near", "alphaMin", "alphaMax", "lowpass", "crossingCutoff"]) gl.uniform1f(at[name], facts[name]);
  gl.uniform1i(at.near_plane_policy, facts.near_plane_policy);
  gl.useProgram(finalProgram.made);
  gl.uniform3f(finalProgram.at.background, ...facts.background);
  listen();
  const asked = new URLSearchParams(location.hash.slice(1)), kinds = ["colours", "normals", "depth"];
  if (asked.has("depths")) fixed = asked.get("depths").split(",").map(Number);
  if (asked.has("view")) goTo(Number(asked.get("view")) || 0);
  else home();
  show(Math.max(0, kinds.indexOf(asked.get("kind"))));
  if (facts.served) await connect();
  $("wait").remove();
}

function failed(error) {
  document.body.dataset.drawn = "failed";
  const line = document.createElement("p");
  line.textContent = `Cannot draw here: ${error.message}`;
  line.id = "failed";
  document.body.append(line);
}
