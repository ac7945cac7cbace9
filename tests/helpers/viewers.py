"""Viewers of other people from npm, in a headless browser: our files from a camera of ours, beside our own rendering.

::

    PYTHONPATH=src python tests/helpers/viewers.py RUN --out FOLDER [--up 0 0 1] [--viewers spark babylon]

Writes the splats of a run, or of a file of splats, in every layout that a viewer says it reads, turned so that what is
up is -y, as viewers take it; opens each file in each of them and prints a row of Markdown for it: PSNR against gs2d's
own rendering from the same camera (both over white), and which axis of the splats is up there. A stream is shown by
PlayCanvas's engine at each of its levels, beside our rendering of that level, and by SuperSplat's viewer near and far,
coloured by level. FOLDER/viewers.jpg and FOLDER/viewers-levels.jpg have all pictures, FOLDER/shots each one. Needs npm
and Chromium, and says so where it cannot have them.
"""

from __future__ import annotations

import argparse
import functools
import http.server
import json
import math
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageDraw

from browser import browser, require_browser
from gs2d.contrib.formats.sog import read_level
from gs2d.core.camera import look_at
from gs2d.core.splats import Splats
from gs2d.core.transforms import transform_splats
from gs2d.io.formats.registry import LAYOUTS, read_splats, write_layout
from gs2d.render.api import rasterize
from gs2d.render.types import RasterSettings
from npm import VERSIONS, forget, package

WIDTH, HEIGHT = 480, 360
FRAMES = 20  # drawn before the picture is taken: sorting is done beside drawing
PATIENCE = 240.0  # s: the frames are drawn without a GPU

# How a viewer's frame lies to that of the splats: factors of x, y, z. The last one is left-handed, as its viewer is.
AS_IT_IS, ABOUT_X, ABOUT_Z, LEFT = (1, 1, 1), (1, -1, -1), (-1, -1, 1), (1, -1, 1)
WORDS = {AS_IT_IS: "+y", ABOUT_X: "-y", ABOUT_Z: "-y", LEFT: "-y"}  # which axis of the splats is up there


@dataclass(frozen=True)
class Camera:
    """A camera without roll: what is up in a picture is -y of the splats, as viewers of 3D Gaussians take it.

    Attributes
    ----------
    eye, target : tuple of 3 floats
        World units of the file.
    fov : float
        Of the height, degrees.
    """

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    fov: float = 40.0

    def told(self, frame: Sequence[int]) -> dict[str, Any]:
        """Return what a page needs, in a frame of its own."""
        turn = np.array(frame, float)
        return {
            "eye": (turn * self.eye).tolist(),
            "target": (turn * self.target).tolist(),
            "up": (turn * (0.0, -1.0, 0.0)).tolist(),
            "fov": self.fov,
            "wide": math.degrees(2 * math.atan(math.tan(math.radians(self.fov) / 2) * WIDTH / HEIGHT)),
            "left": bool(turn.prod() < 0),
            "width": WIDTH,
            "height": HEIGHT,
        }

    def drawn(self, splats: Splats) -> np.ndarray:
        """Return our rendering over white, [H, W, 3]."""
        focal = HEIGHT / 2 / math.tan(math.radians(self.fov) / 2)
        eye, target = np.array(self.eye), np.array(self.target)
        camera = look_at(eye, target, np.array([0.0, -1.0, 0.0]), width=WIDTH, height=HEIGHT, fx=focal)
        settings = RasterSettings(near=0.01, background=(1.0, 1.0, 1.0), sh_degree=splats.sh_degree)
        return np.asarray(rasterize(splats, camera, settings).color.detach().clamp(0, 1).cpu().numpy())


@dataclass(frozen=True)
class Viewer:
    """A program that draws splats in a page.

    Attributes
    ----------
    packages : of npm; the first one gives the version
    page : the page's text, for ``{file, eye, target, up, fov, width, height}`` in ``GIVEN``
    frames : the layouts that it reads by its documentation, and how its frame lies to the splats' in each
    """

    packages: tuple[str, ...]
    page: str
    frames: dict[str, tuple[int, int, int]]

    @property
    def version(self) -> str:
        """Name and version of the package."""
        return f"{self.packages[0]} {VERSIONS[self.packages[0]]}"


_HEAD = """<!doctype html><html><head><meta charset="utf-8"><link rel="icon" href="data:,"><style>
html, body { margin: 0; height: 100%; overflow: hidden; background: white } canvas { display: block }
</style><script>
window.drawn = 0; window.failure = "";
addEventListener("error", e => { window.failure = window.failure || String(e.message); });
addEventListener("unhandledrejection", e => { window.failure = window.failure || String(e.reason); });
const given = GIVEN;
</script>"""

_THREE = (
    _HEAD
    + """<script type="importmap">{"imports": {"three": "./node_modules/three/build/three.module.js",
"three/addons/": "./node_modules/three/examples/jsm/",
"@sparkjsdev/spark": "./node_modules/@sparkjsdev/spark/dist/spark.module.js",
"@mkkellogg/gaussian-splats-3d": "./node_modules/@mkkellogg/gaussian-splats-3d/build/gaussian-splats-3d.module.js"}}
</script></head><body><script type="module">
import * as THREE from "three";
const renderer = new THREE.WebGLRenderer({ antialias: false });
renderer.setSize(given.width, given.height);
renderer.setClearColor(0xffffff, 1);
document.body.appendChild(renderer.domElement);
const camera = new THREE.PerspectiveCamera(given.fov, given.width / given.height, 0.01, 1000);
camera.up.set(...given.up); camera.position.set(...given.eye); camera.lookAt(...given.target);
"""
)

_SPARK = (
    _THREE
    + """
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
const scene = new THREE.Scene();
scene.add(new SparkRenderer({ renderer }));
const mesh = new SplatMesh({ url: given.file });
scene.add(mesh);
await mesh.initialized;
window.splats = mesh.numSplats;
renderer.setAnimationLoop(() => { renderer.render(scene, camera); window.drawn += 1; });
</script></body></html>"""
)

_KELLOGG = (
    _HEAD
    + """<script type="importmap">{"imports": {"three": "./node_modules/three/build/three.module.js"}}</script></head>
<body><div id="r" style="width:480px;height:360px"></div><script type="module">
import * as GS from "./node_modules/@mkkellogg/gaussian-splats-3d/build/gaussian-splats-3d.module.js";
const viewer = new GS.Viewer({ rootElement: document.getElementById("r"), cameraUp: given.up,
  initialCameraPosition: given.eye, initialCameraLookAt: given.target, sharedMemoryForWorkers: false,
  gpuAcceleratedSort: false, sphericalHarmonicsDegree: 2, sceneRevealMode: GS.SceneRevealMode.Instant,
  renderMode: GS.RenderMode.Always });
viewer.camera.fov = given.fov; viewer.camera.updateProjectionMatrix();
viewer.renderer.setClearColor(0xffffff, 1);
await viewer.addSplatScene(given.file, { showLoadingUI: false, progressiveLoad: false });
viewer.start();
const count = () => { window.drawn += 1; requestAnimationFrame(count); }; count();
</script></body></html>"""
)

_PLAYCANVAS = (
    _HEAD
    + """</head><body><canvas id="c" width="480" height="360"></canvas><script type="module">
import * as pc from "./node_modules/playcanvas/build/playcanvas.mjs";
const canvas = document.getElementById("c");
const app = new pc.Application(canvas, { graphicsDeviceOptions: { antialias: false, alpha: false } });
app.setCanvasFillMode(pc.FILLMODE_NONE, given.width, given.height);
app.setCanvasResolution(pc.RESOLUTION_FIXED, given.width, given.height);
app.start();
const camera = new pc.Entity();
camera.addComponent("camera", { clearColor: new pc.Color(1, 1, 1), fov: given.fov, nearClip: 0.01 });
camera.setPosition(...given.eye);
camera.lookAt(new pc.Vec3(...given.target), new pc.Vec3(...given.up));
app.root.addChild(camera);
const asset = new pc.Asset("a", "gsplat", { url: given.file });
app.assets.add(asset);
asset.on("error", message => { window.failure = String(message); });
asset.ready(() => {
  const entity = new pc.Entity();
  entity.addComponent("gsplat", { asset, unified: true });
  app.root.addChild(entity);
  if (given.level !== null) { entity.gsplat.lodRangeMin = given.level; entity.gsplat.lodRangeMax = given.level; }
  app.on("frameend", () => { window.drawn += 1; });
});
app.assets.load(asset);
</script></body></html>"""
)

_BABYLON = (
    _HEAD
    + """</head><body><canvas id="c" width="480" height="360"></canvas>
<script src="node_modules/fflate/umd/index.js"></script>
<script src="node_modules/babylonjs/babylon.js"></script>
<script src="node_modules/babylonjs-loaders/babylonjs.loaders.js"></script><script>
const engine = new BABYLON.Engine(document.getElementById("c"), false), scene = new BABYLON.Scene(engine);
scene.useRightHandedSystem = !given.left;
scene.clearColor = new BABYLON.Color4(1, 1, 1, 1);
const camera = new BABYLON.FreeCamera("a", new BABYLON.Vector3(...given.eye), scene);
camera.upVector = new BABYLON.Vector3(...given.up);
camera.setTarget(new BABYLON.Vector3(...given.target)); camera.fov = given.fov * Math.PI / 180; camera.minZ = 0.01;
BABYLON.SceneLoader.ImportMeshAsync("", "", given.file, scene).then(r => {
  window.kinds = r.meshes.map(m => m.getClassName());
  if (!window.kinds.includes("GaussianSplattingMesh")) window.failure = "no splats: " + window.kinds;
  engine.runRenderLoop(() => { scene.render(); window.drawn += 1; });
}).catch(e => { window.failure = String(e); });
</script></body></html>"""
)

_SUPERSPLAT = (
    _HEAD
    + """<link rel="stylesheet" href="./node_modules/@playcanvas/supersplat-viewer/public/index.css"></head><body>
<script type="module">
import { createViewer } from "./node_modules/@playcanvas/supersplat-viewer/public/index.js";
const off = { sharpness: { enabled: false, amount: 0 }, bloom: { enabled: false, intensity: 0, blurLevel: 0 },
  grading: { enabled: false, brightness: 1, contrast: 1, saturation: 1, tint: [1, 1, 1] },
  vignette: { enabled: false, intensity: 0, inner: 0, outer: 1, curvature: 1 },
  fringing: { enabled: false, intensity: 0 } };
const settings = { version: 2, tonemapping: "none", highPrecisionRendering: false, background: { color: [1, 1, 1] },
  postEffectSettings: off, animTracks: [], annotations: [], startMode: "default",
  cameras: [{ initial: { position: given.eye, target: given.target, fov: given.wide } }] };
const viewer = await createViewer({ container: document.body, settings, contentUrl: given.file, ui: given.ui,
  noanim: true, renderer: "webgl", colorize: given.colorize, fullload: given.fullload });
window.viewer = viewer;
viewer.events.on("loaded:changed", () => { const count = () => { window.drawn += 1; requestAnimationFrame(count); };
  count(); });
</script></body></html>"""
)

VIEWERS = {
    "spark": Viewer(
        ("@sparkjsdev/spark", "three"),
        _SPARK,
        {"3dgs": AS_IT_IS, "compressed": AS_IT_IS, "spz": ABOUT_X, "spz4": ABOUT_X, "sog": AS_IT_IS, "splat": AS_IT_IS},
    ),
    "playcanvas": Viewer(
        ("playcanvas",),
        _PLAYCANVAS,
        {"3dgs": AS_IT_IS, "compressed": AS_IT_IS, "sog": AS_IT_IS, "streamed": AS_IT_IS},
    ),
    "supersplat": Viewer(
        ("@playcanvas/supersplat-viewer",),
        _SUPERSPLAT,
        {"3dgs": ABOUT_Z, "compressed": ABOUT_Z, "sog": ABOUT_Z, "streamed": ABOUT_Z},
    ),
    "kellogg": Viewer(
        ("@mkkellogg/gaussian-splats-3d", "three"),
        _KELLOGG,
        {"3dgs": AS_IT_IS, "splat": AS_IT_IS, "compressed": AS_IT_IS, "spz": ABOUT_X},
    ),
    "babylon": Viewer(
        ("babylonjs", "babylonjs-loaders", "fflate"),
        _BABYLON,
        {"3dgs": LEFT, "compressed": LEFT, "sog": LEFT, "splat": LEFT, "gltf": ABOUT_Z},
    ),
}


class ViewerError(Exception):
    """What a viewer said instead of drawing a file."""


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve a folder to this machine and yield its address."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder)))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def installed(viewer: Viewer, folder: Path) -> None:
    """Let a folder that is served have a viewer's packages; skip where npm cannot."""
    for name in viewer.packages:
        home = package(name)
    modules = home.parents[1 if viewer.packages[-1].startswith("@") else 0]
    if not (folder / "node_modules").exists():
        (folder / "node_modules").symlink_to(modules)


def drawn_by(viewer: Viewer, layout: str, camera: Camera, folder: Path, address: str, **more: Any) -> np.ndarray:
    """Return what a viewer shows of the file of a layout in a served folder, [H, W, 3] in [0, 1].

    Parameters
    ----------
    **more
        Beyond what is given to every page: ``level`` of a stream, ``colorize`` by levels.

    Raises
    ------
    ViewerError
        It cannot open the file.
    """
    given = {"file": file_of(layout), "ui": False, "colorize": False, "fullload": False, "level": None}
    page = viewer.page.replace("GIVEN", json.dumps(given | camera.told(viewer.frames[layout]) | more))
    (folder / "index.html").write_text(page, encoding="utf-8")
    with browser() as tab:
        tab.size(WIDTH, HEIGHT)
        try:
            tab.open(f"{address}/index.html")
            tab.until(f"window.failure || window.drawn >= {FRAMES}", PATIENCE)
        except AssertionError as error:
            raise ViewerError(str(error)) from None
        if failure := tab.ask("window.failure"):
            raise ViewerError(failure)
        return tab.image()


def file_of(layout: str) -> str:
    """Name of the file of a layout in the served folder."""
    ending = LAYOUTS.get(layout).ending
    return f"streamed{ending}" if layout == "streamed" else f"{layout}{ending}"


def written(splats: Splats, layouts: Sequence[str], folder: Path) -> None:
    """Write splats into a folder, in layouts."""
    for layout in layouts:
        path = folder / file_of(layout)
        path.parent.mkdir(exist_ok=True)
        write_layout(path, splats, layout)


def psnr(image: np.ndarray, other: np.ndarray) -> float:
    """Between two pictures in [0, 1], dB."""
    return float(-10 * np.log10(max(np.square(image - other).mean(), 1e-20)))


def upright(splats: Splats, up: Sequence[float]) -> Splats:
    """Return splats turned so that ``up`` is -y."""
    from scipy.spatial.transform import Rotation

    turn, _ = Rotation.align_vectors([[0.0, -1.0, 0.0]], [up])
    return transform_splats(splats, 1.0, turn.as_matrix(), np.zeros(3))


def camera_for(splats: Splats, distance: float = 2.2) -> Camera:
    """Return a camera that has all of the splats in its picture, from a little above."""
    means = splats.means.detach().numpy().astype(np.float64)
    low, high = np.percentile(means, [1, 99], axis=0)
    centre, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    eye = centre + distance * radius * np.array([0.49, -0.37, -0.79])
    return Camera(tuple(eye.tolist()), tuple(centre.tolist()))


def _sheet(path: Path, shots: dict[str, np.ndarray], columns: int, width: int) -> None:
    """Write pictures side by side, each with its name."""
    height = width * HEIGHT // WIDTH
    rows = -(-len(shots) // columns)
    sheet = Image.new("RGB", (columns * width, rows * (height + 14)), "white")
    for i, (name, shot) in enumerate(shots.items()):
        x, y = i % columns * width, i // columns * (height + 14)
        small = Image.fromarray((shot * 255).round().astype(np.uint8)).resize((width, height), Image.Resampling.LANCZOS)
        sheet.paste(small, (x, y))
        ImageDraw.Draw(sheet).text((x + 4, y + height), name, fill="black")
    sheet.save(path, quality=80)


def _all_shots(names: Sequence[str], splats: Splats, folder: Path, address: str) -> dict[str, np.ndarray]:
    """Open every file in every viewer; rows of Markdown are printed."""
    camera = camera_for(splats)
    shots = {"gs2d": camera.drawn(splats)}
    print("| viewer | file | PSNR to gs2d, dB | axis of the splats that is up there |\n|---|---|---|---|")
    for name in names:
        viewer = VIEWERS[name]
        for layout, frame in viewer.frames.items():
            try:
                shot = drawn_by(viewer, layout, camera, folder, address)
            except ViewerError as error:
                print(f"| {viewer.version} | `{layout}` | not opened: {str(error)[:120]} | |", flush=True)
                continue
            print(f"| {viewer.version} | `{layout}` | {psnr(shot, shots['gs2d']):.1f} | {WORDS[frame]} |", flush=True)
            shots[f"{name}: {layout}"] = shot
    return shots


def _level_shots(splats: Splats, folder: Path, address: str) -> dict[str, np.ndarray]:
    """Show a stream at each of its levels, and coloured by level from near and far."""
    camera, stream = camera_for(splats), folder / file_of("streamed")
    shots = {}
    print("\n| level | splats | PlayCanvas to gs2d's rendering of the level, dB | to that of all splats, dB |\n"
          "|---|---|---|---|")  # fmt: skip
    for level, count in enumerate(json.loads(stream.read_text(encoding="utf-8"))["counts"]):
        shot = drawn_by(VIEWERS["playcanvas"], "streamed", camera, folder, address, level=level)
        own = camera.drawn(read_level(stream, level).to_surfels(stream))
        row = f"| {level} | {count:,} | {psnr(shot, own):.1f} | {psnr(shot, camera.drawn(splats)):.1f} |"
        print(row, flush=True)
        shots[f"PlayCanvas, level {level}: {count:,} splats"] = shot
    for words, distance in (("near", 1.2), ("far", 12.0)):
        shots[f"SuperSplat, levels in colours, {words}"] = drawn_by(
            VIEWERS["supersplat"], "streamed", camera_for(splats, distance), folder, address, colorize=True
        )
    return shots


def main(argv: Sequence[str] | None = None) -> int:
    """Write the pictures and print the tables of a run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--up", type=float, nargs=3, default=(0.0, 0.0, 1.0))
    parser.add_argument("--viewers", nargs="+", choices=list(VIEWERS), default=list(VIEWERS))
    options = parser.parse_args(argv)
    splats = upright(read_splats(options.run / "splats.ply" if options.run.is_dir() else options.run), options.up)
    (options.out / "shots").mkdir(parents=True, exist_ok=True)
    try:
        require_browser()
        with tempfile.TemporaryDirectory(prefix="gs2d-viewers-") as home:
            folder = Path(home)
            for name in options.viewers:
                installed(VIEWERS[name], folder)
            written(splats, sorted({each for name in options.viewers for each in VIEWERS[name].frames}), folder)
            with served(folder) as address:
                shots = _all_shots(options.viewers, splats, folder, address)
                levels = (
                    _level_shots(splats, folder, address)
                    if {"playcanvas", "supersplat"} <= set(options.viewers)
                    else {}
                )
    except pytest.skip.Exception as reason:
        print(f"error: {reason.msg}", file=sys.stderr)
        return 2
    finally:
        forget()
    for name, shot in (shots | levels).items():
        place = options.out / "shots" / f"{name.replace(': ', '-').replace(', ', '-').replace(' ', '_')}.png"
        Image.fromarray((shot * 255).round().astype(np.uint8)).save(place)
    _sheet(options.out / "viewers.jpg", shots, 6, 220)
    if levels:
        _sheet(options.out / "viewers-levels.jpg", levels, 3, 300)
    return 0


if __name__ == "__main__":
    sys.exit(main())
