// The cameras of the photographs as frustums, and the photograph of the view.
function makeFrustums() {
  $("cameras").innerHTML = facts.cameras.map(() => '<path role="button"><title></title></path>').join("");
  $("cameras").querySelectorAll("path").forEach((path, i) => {
    path.querySelector("title").textContent = facts.cameras[i].name;
    path.onclick = () => goTo(i);
  });
  $("photograph").onclick = () => ($("photograph").hidden = true);
}

function drawFrustums() {
  showPhotograph();
  const isOn = isPressed("showcameras");
  $("cameras").style.display = isOn ? "" : "none";
  if (!isOn) return;
  const depth = 0.05 * facts.unit;
  $("cameras").querySelectorAll("path").forEach((path, i) => {
    const c = cameraOf(i);
    const corner = (x, y) =>
      plus(plus(plus(c.eye, c.right, (depth * (x - c.cx)) / c.fx), c.down, (depth * (y - c.cy)) / c.fy), c.ahead, depth);
    const [tip, ...corners] = [c.eye, corner(0, 0), corner(c.w, 0), corner(c.w, c.h), corner(0, c.h)].map(onScreen);
    const width = Math.max(...corners.map((p) => Math.hypot(p.x - tip.x, p.y - tip.y)));
    const isVisible = [tip, ...corners].every((p) => p.z > facts.near) && width < 0.3 * canvas.clientWidth;
    const sides = corners.map((p, k) => `M${[tip, p, corners[(k + 1) % 4]].map(pathPoint).join("L")}Z`);
    path.setAttribute("d", isVisible ? sides.join("") : "");
  });
}

function showPhotograph() {
  // Beside the view of its camera, until the visitor moves or closes it.
  const isNew = atPhotograph && $("photograph").dataset.view !== String(shown);
  if (!atPhotograph) {
    $("photograph").hidden = true;
    delete $("photograph").dataset.view;
  } else if (isNew && offer.photographs) {
    $("photograph").dataset.view = shown;
    $("photograph").querySelector("img").src = photographSource(shown);
    $("photograph").hidden = false;
  }
}
