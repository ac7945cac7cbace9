// A page that gs2d serves: it fetches splats, mesh and images from its own server.
const POLL = 1000; // ms between two questions whether the splats have changed
const LOST = "gs2d no longer answers: it was stopped, or the training is finished. This is the last state that was received.";
let mesh = null, version = 0, meshAsked = false, imageShown = -1;

const token = new URLSearchParams(location.search).get("token");
const address = (path, values = {}) => `${path}?${new URLSearchParams({ token, ...values })}`;

async function fetched(path, values) {
  const answer = await fetch(address(path, values));
  if (!answer.ok) throw Error(await answer.text());
  return answer;
}

function say(text) {
  $("status").textContent = text;
  $("status").hidden = !text;
}

async function fetchSplats() {
  const answer = await fetched("splats", { stage: $("stage").value });
  const buffer = await answer.arrayBuffer();
  Object.assign(facts, JSON.parse(answer.headers.get("X-Splats")));
  load(buffer);
  redraw();
}

async function poll() {
  try {
    const state = await (await fetched("state")).json();
    say(state.status);
    if (state.version !== version && isPressed("live")) {
      version = state.version;
      await fetchSplats();
    }
  } catch (error) {
    if (error instanceof TypeError) return say(LOST); // of fetch: nobody answers
    say(error.message);
  }
  setTimeout(poll, POLL);
}

const isPressed = (id) => $(id).getAttribute("aria-pressed") === "true";

function toggle(id) {
  $(id).hidden = false;
  $(id).onclick = () => {
    $(id).setAttribute("aria-pressed", !isPressed(id));
    touched();
  };
}

async function connect() {
  const { stages, has_mesh, has_images, is_live } = facts.served, stage = $("stage");
  stage.replaceChildren(...stages.map((name) => new Option(name)));
  stage.selectedIndex = stages.length - 1;
  stage.hidden = stages.length < 2;
  stage.onchange = () => fetchSplats().then(() => say(""), (error) => say(error.message));
  document.querySelector("[data-kind='3']").hidden = !has_mesh;
  if (has_images) ["showcameras", "photo"].forEach(toggle);
  makeCameras();
  if (!is_live) return fetchSplats();
  toggle("live");
  poll();
}

// ---- the mesh ----
async function fetchMesh() {
  const data = await (await fetched("mesh")).arrayBuffer(); // .glb: a header, JSON, then the arrays
  const length = new DataView(data).getUint32(12, true);
  const gltf = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 20, length)));
  const bytes = (i) => {
    const { byteOffset, byteLength } = gltf.bufferViews[i], begin = 28 + length + byteOffset;
    return data.slice(begin, begin + byteLength);
  };
  const part = (i, numbers) => new numbers(bytes(gltf.accessors[i].bufferView));
  const { attributes, indices } = gltf.meshes[0].primitives[0], textured = "TEXCOORD_0" in attributes;
  const places = part(attributes.POSITION, Float32Array).map((x, i) => x - facts.origin[i % 3]), faces = part(indices, Uint32Array);
  const made = { ...program(gl, "mesh-vert", "mesh-frag"), count: faces.length, array: gl.createVertexArray(), textured };
  gl.bindVertexArray(made.array);
  const attribute = (i, values, size, type) => {
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(i);
    gl.vertexAttribPointer(i, size, type, type !== gl.FLOAT, 0, 0);
  };
  attribute(0, places, 3, gl.FLOAT);
  if (textured) attribute(1, part(attributes.TEXCOORD_0, Float32Array), 2, gl.FLOAT);
  else if ("COLOR_0" in attributes) attribute(1, part(attributes.COLOR_0, Uint16Array), 4, gl.UNSIGNED_SHORT);
  else gl.vertexAttrib3f(1, 0.5, 0.5, 0.5);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces, gl.STATIC_DRAW);
  gl.bindVertexArray(null);
  if (textured) {
    const image = await createImageBitmap(new Blob([bytes(gltf.images[0].bufferView)], { type: "image/png" }));
    made.atlas = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, made.atlas);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
    gl.generateMipmap(gl.TEXTURE_2D);
  }
  mesh = made;
  touched();
}

function drawMesh() {
  if (!meshAsked) fetchMesh().catch((error) => say(error.message));
  meshAsked = true;
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  gl.viewport(0, 0, canvas.width, canvas.height);
  gl.clearColor(...facts.background, 1);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  if (!mesh) return;
  gl.disable(gl.BLEND);
  gl.enable(gl.DEPTH_TEST);
  aim(mesh, canvas.width, canvas.height);
  gl.uniform1f(mesh.at.near, facts.near);
  gl.uniform1i(mesh.at.textured, mesh.textured);
  gl.activeTexture(gl.TEXTURE0);
  gl.bindTexture(gl.TEXTURE_2D, mesh.atlas || null);
  gl.bindVertexArray(mesh.array);
  gl.drawElements(gl.TRIANGLES, mesh.count, gl.UNSIGNED_INT, 0);
  gl.bindVertexArray(null);
  gl.disable(gl.DEPTH_TEST);
}

// ---- cameras and their images ----
function makeCameras() {
  $("cameras").innerHTML = "<path/>" + facts.cameras.map(() => '<circle r="5"/>').join("");
  $("cameras").querySelectorAll("circle").forEach((circle, i) => (circle.onclick = () => goTo(i)));
}

function drawServed() {
  $("cameras").style.display = isPressed("showcameras") ? "" : "none";
  if (isPressed("showcameras")) drawCameras();
  $("photograph").hidden = !isPressed("photo");
  if (isPressed("photo") && imageShown !== shown) {
    imageShown = shown;
    $("photograph").src = address("image", { view: shown });
  }
}

function drawCameras() {
  const side = 0.05 * facts.unit, lines = [];
  $("cameras").querySelectorAll("circle").forEach((circle, i) => {
    const c = start(i), middle = onScreen(c.eye);
    const isAhead = middle.z > facts.near;
    circle.style.display = isAhead ? "" : "none";
    if (isAhead) circle.setAttribute("cx", middle.x.toFixed(1));
    if (isAhead) circle.setAttribute("cy", middle.y.toFixed(1));
    const corner = (x, y) => plus(plus(plus(c.eye, c.right, (side * (x - c.cx)) / c.fx), c.down, (side * (y - c.cy)) / c.fy), c.ahead, side);
    const corners = [corner(0, 0), corner(c.w, 0), corner(c.w, c.h), corner(0, c.h)];
    for (const [a, b] of corners.flatMap((p, k) => [[c.eye, p], [p, corners[(k + 1) % 4]]])) {
      const ends = cutAtNear(a, b);
      if (ends) lines.push("M" + ends.map(onScreen).map((p) => `${p.x.toFixed(1)} ${p.y.toFixed(1)}`).join("L"));
    }
  });
  $("cameras").querySelector("path").setAttribute("d", lines.join(""));
}
