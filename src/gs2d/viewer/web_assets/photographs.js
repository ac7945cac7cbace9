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
    const corners = [corner(0, 0), corner(c.w, 0), corner(c.w, c.h), corner(0, c.h)];
    const edges = corners.flatMap((p, k) => [[c.eye, p, corners[(k + 1) % 4]]]);
    const isVisible = !(atPhotograph && i === shown) && [c.eye, ...corners].every((p) => onScreen(p).z > facts.near);
    path.setAttribute("d", isVisible ? edges.map((points) => `M${points.map(onScreen).map(pathPoint).join("L")}Z`).join("") : "");
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
