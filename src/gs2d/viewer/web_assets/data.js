// Splats, meshes and photographs: embedded in this page, or requested from the server that sent it.
const POLL = 1000; // ms between two requests for the state of a training
const LOST = "gs2d does not answer: it was stopped, or the training has ended. This is the last state received.";
const token = new URLSearchParams(location.search).get("token");
const address = (path, values = {}) => `${path}?${new URLSearchParams({ token, ...values })}`;
let version = 0; // of a training that is shown live

async function request(path, values) {
  const answer = await fetch(address(path, values));
  if (!answer.ok) throw Error(await answer.text());
  return answer;
}

async function dataOf(name) {
  // The bytes of an embedded file, or of one on the server.
  if (offer.served) return (await request(name)).arrayBuffer();
  const bytes = Uint8Array.from(atob($(name).textContent.trim()), (c) => c.charCodeAt(0));
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
}

function photographSource(i) {
  if (offer.served) return address("photograph", { view: i });
  return `data:image/jpeg;base64,${$("photographs").textContent.trim().split("\n")[i]}`;
}

function showStatus(text) {
  $("status").textContent = text;
  $("status").hidden = !text;
}

async function requestSplats() {
  const answer = await request("splats", { stage: $("stage").value });
  const buffer = await answer.arrayBuffer();
  Object.assign(facts, JSON.parse(answer.headers.get("X-Splats")));
  load(buffer);
}

async function poll() {
  try {
    const state = await (await request("state")).json();
    showStatus(state.status);
    if (state.version !== version && isPressed("live")) {
      version = state.version;
      await requestSplats();
    }
  } catch (error) {
    if (error instanceof TypeError) return showStatus(LOST); // fetch got no answer
    showStatus(error.message);
  }
  setTimeout(poll, POLL);
}

async function connect() {
  const stage = $("stage");
  stage.replaceChildren(...offer.stages.map((name) => new Option(name)));
  stage.selectedIndex = offer.stages.length - 1;
  stage.hidden = offer.stages.length < 2;
  stage.onchange = () => requestSplats().then(() => showStatus(""), (error) => showStatus(error.message));
  $("live").hidden = !offer.live;
  $("live").onclick = () => press("live", !isPressed("live"));
  if (offer.live) poll();
  else await requestSplats();
}
