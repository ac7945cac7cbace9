// Images that enlarge, and pairs with a line between them that moves. No network, no libraries.
"use strict";
document.documentElement.classList.add("js");

function wipes(figure) {
  const both = figure.querySelector(".both"), range = figure.querySelector("input");
  const show = () => both.style.setProperty("--at", `${range.value}%`);
  const follow = (e) => {
    const box = both.getBoundingClientRect();
    range.value = (100 * (e.clientX - box.left)) / box.width;
    show();
  };
  both.onpointerdown = (e) => {
    if (e.button) return;
    both.setPointerCapture(e.pointerId);
    follow(e);
    range.focus({ preventScroll: true });
    e.preventDefault(); // no text is selected, no image dragged
  };
  both.onpointermove = (e) => both.hasPointerCapture(e.pointerId) && follow(e);
  range.oninput = show;
  show();
}

const all = []; // what can be enlarged, in the order of the page: { title, make }
const box = document.querySelector("dialog.large"), stage = box.querySelector(".stage");
let shown = 0;

function open(i) {
  shown = (i + all.length) % all.length;
  stage.replaceChildren(all[shown].make());
  box.querySelector("p").textContent = `${all[shown].title} (${shown + 1} of ${all.length})`;
  if (!box.open) box.showModal();
}

function larger(img) {
  // The full image from the run folder, or the one in this file where the folder is missing.
  const made = new Image();
  made.alt = img.alt;
  made.src = img.src;
  if (img.dataset.full) {
    const full = new Image();
    full.onload = () => (made.src = full.src);
    full.src = img.dataset.full;
  }
  return made;
}

function largerWipe(figure) {
  const copy = figure.cloneNode(true);
  copy.querySelector("figcaption")?.remove();
  for (const img of copy.querySelectorAll("img")) {
    if (!img.dataset.full) continue;
    const full = new Image(), inside = img;
    full.onload = () => (inside.src = full.src);
    full.src = img.dataset.full;
  }
  const img = figure.querySelector("img");
  // As large as the window, even if the image has fewer pixels.
  copy.style.width = `min(100%, calc((100dvh - 6rem) * ${img.naturalWidth / img.naturalHeight || 1.5}))`;
  wipes(copy);
  return copy;
}

for (const figure of document.querySelectorAll("main figure:not(.mesh)")) {
  const i = all.length, img = figure.querySelector("img");
  if (!img) continue;
  if (figure.matches(".wipe")) {
    wipes(figure);
    all.push({ title: figure.dataset.title, make: () => largerWipe(figure) });
    figure.querySelector("button.larger").onclick = () => open(i);
    continue;
  }
  const button = document.createElement("button");
  button.className = "zoom";
  button.type = "button";
  button.setAttribute("aria-label", `enlarge: ${img.alt}`);
  button.onclick = () => open(i);
  img.replaceWith(button);
  button.append(img);
  all.push({ title: img.alt, make: () => larger(img) });
}
stage.onclick = (e) => e.target.closest(".wipe") || box.close();
box.querySelector(".close").onclick = () => box.close();
box.querySelector(".before").onclick = () => open(shown - 1);
box.querySelector(".next").onclick = () => open(shown + 1);
box.onkeydown = (e) => {
  const step = { ArrowLeft: -1, ArrowRight: 1 }[e.key];
  if (step && e.target.type !== "range") open(shown + step);
};
// The event comes after the closing: it may be open again by then.
box.onclose = () => box.open || stage.replaceChildren();
