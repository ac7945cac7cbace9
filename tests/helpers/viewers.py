"""Viewers of other people from npm, in a headless browser: our files beside our own rendering, from one camera."""

from __future__ import annotations

import functools
import http.server
import json
import math
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from browser import browser
from gs2d.core.camera import look_at
from gs2d.core.splats import Splats
from gs2d.io.formats.registry import LAYOUTS, write_layout
from gs2d.render.api import rasterize
from gs2d.render.types import RasterSettings
from npm import VERSIONS, package

WIDTH, HEIGHT = 480, 360
FRAMES = 20  # drawn before the picture is taken: sorting is done beside drawing
PATIENCE = 240.0  # s: the frames are drawn without a GPU

# How a viewer's frame lies to that of the splats: factors of x, y, z. The last one is left-handed, as its viewer is.
AS_IT_IS, ABOUT_X, ABOUT_Z, LEFT = (1, 1, 1), (1, -1, -1), (-1, -1, 1), (1, -1, 1)


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
