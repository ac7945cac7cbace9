"""The demo's capture: a scene with an exactly known surface, drawn by the ray caster."""
