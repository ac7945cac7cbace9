// Starts the page. The part of the address after "#" selects view, show, kind, depths (the ends of the scale) and bare.
async function begin() {
  if (!gl) throw Error("this browser has no WebGL 2");
  const chosen = new URLSearchParams(location.hash.slice(1));
  if (chosen.has("bare")) document.body.classList.add("bare");
  if (chosen.has("depths")) fixedRange = chosen.get("depths").split(",").map(Number);
  prepareSplats();
  const buffer = offer.served ? new ArrayBuffer(0) : await dataOf("splats");
  listen();
  if (chosen.has("view")) goTo(Number(chosen.get("view")) || 0);
  else goHome();
  cropped = isCropped() ? 1 : 0;
  load(buffer);
  kind = Math.max(0, ["colours", "normals", "depth"].indexOf(chosen.get("kind")));
  show(offer.meshes.includes(chosen.get("show")) ? chosen.get("show") : "splats");
  updateCrop();
  if (offer.served) await connect();
  $("wait").remove();
}

function fail(error) {
  document.body.dataset.drawn = "failed";
  $("wait")?.remove();
  $("failed").textContent = `The scene cannot be shown: ${error.message}.`;
  $("failed").hidden = false;
}

begin().catch(fail);
