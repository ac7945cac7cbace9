"""One example of each extension point of gs2d, in a package of its own; docs/extending.md shows it piece by piece."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch

import gs2d
from gs2d.cli.commands import Common
from gs2d.config.actions import Action
from gs2d.config.arguments import Arg
from gs2d.config.densify import Densify
from gs2d.data.camera_models import CameraModel
from gs2d.errors import DivergedError
from gs2d.io.gaussians import Gaussians
from gs2d.meshing.extract import extract
from gs2d.render.cpu_backend import CpuBackend
from gs2d.training.actions.entry_action import EntryAction
from gs2d.training.densify.densifier import Densifier
from gs2d.training.events import Densified
from gs2d.training.rows import keep_rows


@gs2d.register_loss("example-contrast")
def contrast(output, view, gain=1.0):
    """Compare the spread of colours with that of the photograph."""
    return gain * (output.color.std() - view.target.std()).square()


@gs2d.register_loss("example-outside", needs=["silhouette", "distortion"])
def outside(output, view):
    """Penalise opacity and distortion where the photograph is transparent."""
    if view.silhouette is None:
        return None
    return ((1 - view.silhouette) * (output.alpha + output.distortion)).mean()


@gs2d.register_loss("example-brightness")
class Brightness(gs2d.Loss):
    """Compare the mean brightness with that of the photograph, computed once before training."""

    def prepare(self, scene, recipe, device):
        self.means = [torch.tensor(view.image()[..., :3].mean() / 255, device=device) for view in scene.train]

    def __call__(self, output, view):
        return (output.color.mean() - self.means[view.index]).square()


@gs2d.register_reader("example-link")
class LinkReader:
    """A folder whose capture.txt names the folder where the capture is."""

    protocol = "nerf-synthetic"

    def detect(self, path):
        return (path / "capture.txt").is_file()

    def read(self, path, *, downscale):
        return gs2d.load_scene((path / "capture.txt").read_text().strip(), downscale=downscale)


@gs2d.register_camera_model("example-equisolid")
class Equisolid(CameraModel):
    """A fisheye that shows the angle t from its axis at radius 2 k sin(t / 2)."""

    parameters = ("k1",)
    is_wide = True

    def project(self, lens, rays):
        across = np.maximum(np.hypot(rays[..., 0], rays[..., 1]), 1e-12)
        radius = 2 * lens.radial[0] * np.sin(np.arctan2(across, rays[..., 2]) / 2)
        return rays[..., :2] * (radius / across)[..., None], np.ones(across.shape, bool)


@gs2d.register_densifier("example-prune")
class PruneFaint(Densifier):
    """Drop the faintest splats at one iteration."""

    def __init__(self, surroundings, at, count=1):
        super().__init__(surroundings)
        self.at, self.count = at, count

    def changes(self, iteration):
        return iteration == self.at

    def after_backward(self, state, output, iteration):
        if iteration != self.at:
            return ()
        keep = torch.ones(len(state.splats), dtype=torch.bool, device=state.splats.device)
        keep[state.splats.opacity_logits.argsort()[: self.count]] = False
        keep_rows(state, keep)
        return (Densified(self.surroundings.stage, iteration, 0, 0, self.count, 0, len(state.splats)),)


@gs2d.register_action("example-near")
class SelectNear(EntryAction):
    """Write the row group of the splats nearest to the origin."""

    def __init__(self, writes, fraction=0.5):
        self.writes, self.fraction = writes, fraction

    def run(self, state, entry):
        distance = state.splats.means.norm(dim=1)
        state.groups[self.writes] = distance <= distance.quantile(self.fraction)
        return ()


@gs2d.register_quantity("example-tint")
class Tint(gs2d.LearnedQuantity):
    """A gain of each channel of each photograph, whose mean over all photographs is 1."""

    title = "Tint of the photographs"
    shape = (3,)

    def numbers(self, values, index):
        return values[index] - values.mean(dim=0)

    @staticmethod
    def apply(color, numbers, at):
        return color * (1 + numbers)

    @staticmethod
    def predicted(scene, brightness):
        mean = sum(view.appearance["example-tint"] for view in scene.train) / len(scene.train)
        return {view.name: mean for view in scene.test}


@gs2d.register_recipe("example-2dgs")
def recipe():
    """Like 2dgs, with losses and a densifier of this package."""
    base = gs2d.get_recipe("2dgs").with_loss(gs2d.LossTerm("example-contrast", 0.1, options={"gain": 2.0}))
    base = base.with_loss(gs2d.LossTerm("example-brightness", 0.1)).with_loss(gs2d.LossTerm("example-outside", 0.1))
    densify = Densify("example-prune", {"at": 3, "count": 2})
    stage = replace(base.stages[0], densify=densify, on_enter=(Action("example-near", {"writes": "near"}),))
    tint = gs2d.Quantity("example-tint", rate=0.01, start=2, prior=0.001)
    return replace(base, name="example-2dgs", learned=(tint,), stages=(stage, *base.stages[1:]))


@gs2d.register_backend("example-checked")
class CheckedBackend(CpuBackend):
    """The native kernels, stopping at the first image that is not finite."""

    name = "example-checked"

    def rasterize(self, splats, camera, settings, screen_probe=None, gradient_rows=None):
        output = super().rasterize(splats, camera, settings, screen_probe, gradient_rows)
        if not torch.isfinite(output.color).all():
            raise DivergedError("an image must be finite, got NaN or infinity; lower a rate")
        return output


@gs2d.register_format("example-xyz", ending=".xyz")
def write_xyz(path, splats):
    """Write the centres as text."""
    np.savetxt(path, splats.means.detach().cpu().numpy(), fmt="%.6g")
    return ("only the centres were written",)


@gs2d.register_section("example-seed", title="Seed of the run")
def seed(run):
    """Show the seed and the last score."""
    if not run.stages:
        return None
    return f"<p>Seed {run.definition['seed']}, {run.last['train']['psnr']:.1f} dB on training views.</p>"


@gs2d.register_splat_reader("example-xyz", endings=(".xyz",))
def read_xyz(path, warn):
    """Read centres from text, as grey disks of one size."""
    means = np.loadtxt(path, dtype=np.float32, ndmin=2)
    warn("only the centres were read")
    count, ones = len(means), np.ones((len(means), 1), np.float32)
    flat, quats = ones * [-4.0, -4.0, -40.0], ones * [1.0, 0.0, 0.0, 0.0]
    empty = np.zeros((count, 0, 3), np.float32)
    return Gaussians(means, np.float32(quats), np.float32(flat), ones[:, 0], 0 * means, empty), "text"


@gs2d.register_mesh_method("example-coarse")
def coarse(frames, options, *, threads, backend):
    """Fuse large voxels."""
    return extract(frames, replace(options, resolution=32), threads=threads, backend=backend)


@gs2d.register_evaluator("example-vertices")
class VertexCount:
    """Compare the number of vertices with the one in vertices.txt beside the capture."""

    has_thresholds = False

    def find(self, capture, ground_truth, notify):
        path = capture / "vertices.txt"
        return int(path.read_text()) if path.is_file() else None

    def score(self, mesh, truth, scene, *, folder, thresholds):
        difference = float(abs(len(mesh.vertices) - truth))
        return {"unit": "vertices", "chamfer": difference, "thresholds": [], "self_check": {"ok": True, "messages": []}}


@gs2d.register_command("example-count", action="gs2d_example:count", group="Examples")
@dataclass(frozen=True, kw_only=True)
class Count(Common):
    """Count the splats of a file."""

    path: Annotated[Path, Arg(metavar="FILE", positional=True)]
    """File of splats."""
    double: bool = False
    """Count each splat twice."""


def count(options, console):
    """Print the number of splats."""
    splats = gs2d.read_splats(options.path)
    number = len(splats) * (1 + options.double)
    console.say(f"{number} splats")
    console.result({"splats": number})
