"""All cases that have a usual formula to compare with."""

from __future__ import annotations

from tests.hard_cases import Case, fields, media, networks, rays, training

CASES = (
    Case(1, "thin fog", "1 − exp(−σδ)", media.thin_media),
    Case(2, "transmittance", "Π(1 − α + 1e-10)", media.transmittance),
    Case(3, "last interval", "1e10 or ∞", media.last_interval),
    Case(4, "overflow of exp", "σ = exp(raw)", media.density_overflow),
    Case(5, "behind opaque walls", "Π(1 − α), adjoint divided by 1 − α", media.opaque_walls),
    Case(6, "dead density", "weights in ±1/√outputs, ReLU", networks.dead_density),
    Case(7, "inverse CDF with empty bins", "`sample_pdf` of 2020", rays.empty_bins),
    Case(8, "sample positions", "not detached", rays.sample_positions),
    Case(9, "Fourier features", "doubled angles", networks.high_octaves),
    Case(10, "NaN", "x > 0 ? x : 0; Adam unguarded", networks.not_a_number),
    Case(11, "ray and box", "slabs as they stand", rays.box),
    Case(12, "NDC, d_z → 0", "appendix C as it stands", rays.projection),
    Case(13, "empty ray", "Σwt / Σw", media.empty_rays),
    Case(14, "thin sheet", "64 even samples", fields.thin_sheet),
    Case(15, "inside the volume", "no clamp to the origin", fields.inside_the_volume),
    Case(16, "unit of the scene", "near 2, far 6", fields.scene_unit),
    Case(17, "saturated colours", "1 / (1 + exp(−x)); white on white", networks.saturation),
    Case(18, "one sample", "`linspace(0, 1, n)`", rays.one_sample),
    Case(19, "HDR targets", "squared error", training.hdr_targets),
    Case(20, "1e5 steps", "progress summed in float32", training.many_steps),
)
