"""Render the conda recipe for each platform, as rattler-build does before a build, without a conda channel.

    python -m venv build/recipe-tools && build/recipe-tools/bin/pip install py-rattler-build==0.73.0
    build/recipe-tools/bin/python scripts/check_recipe.py

rattler-build reports a mistake in the recipe or its variants, and the script exits with 1.
"""

from __future__ import annotations

import sys
from pathlib import Path

import rattler_build as rb

RECIPE = Path(__file__).parents[1] / "packaging" / "conda" / "recipe.yaml"
PLATFORMS = ("linux-64", "linux-aarch64", "osx-arm64", "win-64")


def rendered(platform: str) -> list[rb.RenderedVariant]:
    """Return the rendered recipe of a platform, a variant per Python version."""
    config = rb.PlatformConfig(target_platform=platform)
    variants = rb.VariantConfig.from_file_with_context(RECIPE.parent / "variants.yaml", rb.JinjaConfig(platform=config))
    return rb.Stage0Recipe.from_file(RECIPE).render(variants, rb.RenderConfig(config))


def main() -> int:
    """Render for all platforms and print the dependencies of each."""
    for platform in PLATFORMS:
        variants = rendered(platform)
        pythons = [variant.variant["python"] for variant in variants]
        if len(pythons) < 2:
            print(f"error: {platform} must have a variant for each Python, got {pythons}", file=sys.stderr)
            return 1
        tools = variants[0].recipe.to_dict()["requirements"]["build"]
        print(f"{platform}: Python {', '.join(pythons)}; built with {', '.join(tools)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
