"""Phases of a training run, for the samplers of ``profile_run`` and ``run_cost``."""

from __future__ import annotations

from benchmarks.sampler import Rule

LOGGER, LOOP = "pipeline/train/run_logger.py", "training/trainer.py"
START, CHECKS = "training/start", "training/robust"
RUN_PHASES = (  # names missing from a version of the code never match
    Rule(
        "read the capture",
        (("pipeline/prepare/loaded.py", "prepare_run"), ("pipeline/prepare/loaded.py", "reload_run")),
    ),
    Rule("PSNR curve", ((LOGGER, "_probe_psnr"),)),
    Rule("pictures", (("pipeline/finish/run_images.py", "draw_stage"),)),
    Rule("score a stage", ((LOGGER, "_score_stage"),)),
    Rule("checkpoints", ((LOGGER, "_save"),)),
    Rule("plane sweep", ((f"{START}/plane_sweep.py", "sweep_views"),)),
    Rule("points of the dense start", ((f"{START}/start_points.py", "start_points"),)),
    Rule("free space", ((f"{CHECKS}/free_space_maps.py", ""),)),
    Rule("trials", ((f"{CHECKS}/trial.py", "missed"), (f"{CHECKS}/robustness.py", "remove"))),
    Rule("shine", ((f"{CHECKS}/shine.py", "shine_maps"),)),
    Rule("initial splats", ((LOOP, "_first_state"),)),
    Rule("rank by E_i", (("training/actions/rank_by_error.py", "run"),)),
    Rule("fill the stage 2 cache", (("training/cached_objective.py", "choose_objective"),)),
    Rule("depth maps", (("meshing/depth_maps.py", ""),)),
    Rule("fusion", (("meshing/tsdf_volume.py", ""),)),
    Rule("marching cubes", (("meshing/marching_cubes.py", ""),)),
    Rule("refine the mesh", (("meshing/refine.py", ""),)),
    Rule("texture", (("pipeline/finish/run_texture.py", ""),)),
    Rule("verdict", (("pipeline/finish/run_verdict.py", ""),)),
    Rule("page", (("pipeline/look/page.py", "page_run"),)),
    Rule("mesh", (("pipeline/finish/run_mesh.py", "extract_mesh"),)),
    Rule("report", (("pipeline/finish/run_report.py", "report_run"),)),
    Rule("training iterations", ((LOOP, "step"),)),
    Rule("enter a stage", ((LOOP, "enter"),)),
)
