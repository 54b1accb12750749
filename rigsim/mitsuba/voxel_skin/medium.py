"""Read a Mitsuba medium of voxels as tables for unbiased free paths and transmittances."""

from typing import Any, Final

import numpy as np

from rigsim.arrays import Float64Array
from rigsim.mitsuba.memory import pad_memory
from rigsim.mitsuba.render_error import RenderError

EVEN_TOL: Final = 1e-5
"""Relative range of scattering that counts as constant: products of single precision."""

MIN_RATE: Final = 1e-12
"""Replaces a rate of zero in divisions, 1 / length."""

FAR_MM: Final = 1e30
"""Replaces an infinite length, mm."""


class VoxelMedium:
    """Coefficients of a medium with layers normal to z, for walks of one or all spectral bands.

    Voxels continue beyond the grid as at its border. A horizontal slab is a run of voxel rows that
    share all rates below.

    Parameters
    ----------
    mi
        Mitsuba with the active variant.
    medium
        A ``homogeneous`` medium, or a ``heterogeneous`` one whose ``sigma_t`` and ``albedo`` are
        ``gridvolume`` (axis-aligned, ``filter_type`` nearest) or ``constvolume``.

    Raises
    ------
    RenderError
        The medium is of another kind, or the grids differ in place or shape.

    Notes
    -----
    A flight has events of rate M = max sigma_s + R, where R is the range of sigma_a in the slab. An
    event scatters with probability sigma_s / M and weights the path otherwise (residual ratio
    tracking, Novak et al. 2014, doi:10.1145/2661229.2661292). The slab's minimum of sigma_a acts by
    Beer's law. Every weight is at most 1, in each band. Where scattering is constant, free paths
    are exact; where absorption is constant too, every event scatters.
    """

    def __init__(self, mi: Any, medium: Any) -> None:
        import drjit as dr

        self._mi, self._dr = mi, dr
        self.phase = medium.phase_function()
        sigma_t, albedo, low, high = _read_grids(mi, medium)
        scattering, absorption = sigma_t * albedo, sigma_t * (1.0 - albedo)
        self.bands = int(scattering.shape[-1])
        first = scattering[..., :1]
        self.shares_walks = bool((abs(scattering - first) <= EVEN_TOL * first).all())
        if self.shares_walks:
            scattering = first
        self._shape = scattering.shape[:3]
        self._voxels = int(np.prod(self._shape))
        self._low = mi.Point3f(*(float(x) for x in low))
        self._per_mm = mi.Vector3f(
            *(float(n) / float(b - a) for n, a, b in zip(self._shape[::-1], low, high, strict=True))
        )
        self._tabulate(scattering, absorption, low[2], high[2])
        self._check_lookup(medium, low, high)

    def _tabulate(
        self, scattering: Float64Array, absorption: Float64Array, low: float, high: float
    ) -> None:
        """Store the rates of slabs, the control's optical depth, and the voxels."""
        rows = self._shape[0]
        flat_s = scattering.reshape(rows, -1, scattering.shape[-1])
        flat_a = absorption.reshape(rows, -1, self.bands)
        most, least = flat_s.max(axis=1), flat_s.min(axis=1)
        even = most - least <= EVEN_TOL * most
        most[even] = least[even] = (0.5 * (most + least))[even]
        control = flat_a.min(axis=1)
        swing = flat_a.max(axis=1) - control
        swing[swing <= EVEN_TOL * (control + most)] = 0.0
        if self.shares_walks:
            swing = swing.max(axis=1, keepdims=True)
        self.has_swing, self.is_even = bool(swing.any()), bool(even.all())
        self.has_residual = self.has_swing or not self.is_even
        rates = np.concatenate([most, least, control, swing], axis=1)
        begins = np.ones(rows, bool)
        begins[1:] = ~np.isclose(rates[1:], rates[:-1], rtol=EVEN_TOL, atol=0.0).all(axis=1)
        take = np.flatnonzero(begins)
        self._slabs = len(take)
        self._slab_of_row = self._mi.UInt32((np.cumsum(begins) - 1).astype(np.uint32))
        faces = low + (high - low) / rows * np.append(take, rows)
        extinction = (least + control)[take]
        below_top = np.diff(faces)[:, None] * extinction
        from_top = np.cumsum(below_top[::-1], axis=0)[::-1] - below_top
        self._face_above = self._table(faces[1:, None])
        self._bottom = self._table(np.append(-FAR_MM, faces[1:-1])[:, None])
        self._top = self._table(np.append(faces[1:-1], FAR_MM)[:, None])
        self._depth_above, self._extinction = self._table(from_top), self._table(extinction)
        self._most, self._least, self._control, self._swing = (
            self._table(part[take]) for part in (most, least, control, swing)
        )
        self._scattering = (
            None if self.is_even else self._table(scattering.reshape(-1, flat_s.shape[-1]))
        )
        self._absorption = (
            self._table(absorption.reshape(-1, self.bands)) if self.has_swing else None
        )

    def _table(self, values: Float64Array) -> Any:
        """Store columns one after another."""
        return self._mi.Float(pad_memory(np.ascontiguousarray(values.T, np.float32)))

    def slab(self, z: Any) -> Any:
        """Return the slab of a height."""
        row = self._mi.UInt32(
            self._dr.clip((z - self._low.z) * self._per_mm.z, 0.0, self._shape[0] - 0.5)
        )
        return self._dr.gather(self._mi.UInt32, self._slab_of_row, row)

    def face_ahead(self, z: Any, dz: Any, slab: Any) -> Any:
        """Return the distance to the slab's end along a direction, mm."""
        mi, dr = self._mi, self._dr
        if self._slabs == 1:
            return mi.Float(FAR_MM)
        end = dr.select(
            dz > 0.0, dr.gather(mi.Float, self._top, slab), dr.gather(mi.Float, self._bottom, slab)
        )
        steep = dr.copysign(dr.maximum(dr.abs(dz), MIN_RATE), dz)
        return dr.clip((end - z) / steep, 0.0, FAR_MM)

    def next_slab(self, slab: Any, dz: Any) -> Any:
        """Return the slab beyond the end ahead."""
        return self._dr.select(dz > 0.0, slab + 1, slab - 1)

    def event_rate(self, slab: Any, channel: Any) -> Any:
        """Return M, 1 / mm."""
        rate = self._of_walk(self._most, slab, channel)
        return rate + self._of_walk(self._swing, slab, channel) if self.has_swing else rate

    def control(self, slab: Any, channel: Any) -> Any:
        """Return the slab's minimum of sigma_a in each of the walk's bands, 1 / mm."""
        return self._of_bands(self._control, slab, self._slabs, channel)

    def choose_event(self, p: Any, slab: Any, channel: Any, active: Any) -> tuple[Any, Any]:
        """Return the probability that an event scatters, and the weight if it does not."""
        mi, dr = self._mi, self._dr
        if not self.has_residual:
            return mi.Float(1.0), mi.Spectrum(1.0)
        most = self._of_walk(self._most, slab, channel)
        rate = self.event_rate(slab, channel)
        voxel = self._voxel(p)
        scattering = most
        if self._scattering is not None:
            scattering = self._of_walk(self._scattering, voxel, channel, self._voxels, active)
        rest = dr.maximum(rate - scattering, MIN_RATE)
        kept = 1.0 - self._excess(voxel, slab, channel, active) / rest
        return scattering / dr.maximum(rate, MIN_RATE), dr.maximum(kept, 0.0)

    def control_depth(self, z: Any, channel: Any) -> Any:
        """Return the control's vertical optical depth from the grid's top down to a height."""
        dr, mi = self._dr, self._mi
        slab = self.slab(z)
        above = dr.gather(mi.Float, self._face_above, slab) - z
        found = self._of_bands(self._depth_above, slab, self._slabs, channel)
        return found + self._of_bands(self._extinction, slab, self._slabs, channel) * above

    def residual_transmittance(
        self, p: Any, d: Any, distance: Any, slab: Any, channel: Any, sampler: Any, active: Any
    ) -> Any:
        """Return an estimate of the transmittance over the control's, by ratio tracking."""
        mi, dr = self._mi, self._dr
        if not self.has_residual:
            return mi.Spectrum(1.0)

        def step(t: Any, slab: Any, kept: Any, going: Any, draws: Any) -> tuple[Any, ...]:
            most = self._of_walk(self._most, slab, channel)
            least = self._of_walk(self._least, slab, channel)
            rate = dr.maximum(self.event_rate(slab, channel) - least, MIN_RATE)
            face = self.face_ahead(dr.fma(d.z, t, p.z), d.z, slab)
            free = -dr.log(1.0 - draws.next_1d(going)) / rate
            t = t + dr.minimum(free, face)
            going &= t < distance
            event = going & (free < face)
            voxel = self._voxel(dr.fma(d, t, p))
            over = self._excess(voxel, slab, channel, event)
            if self._scattering is not None:
                found = self._of_walk(self._scattering, voxel, channel, self._voxels, event)
                over += dr.clip(found, least, most) - least
            kept = dr.select(event, kept * dr.maximum(1.0 - over / rate, 0.0), kept)
            slab = dr.select(going & ~event, self.next_slab(slab, d.z), slab)
            return t, slab, kept, going & (dr.max(kept) > 0.0), draws

        return dr.while_loop(
            (mi.Float(0.0), mi.UInt32(slab), mi.Spectrum(1.0), mi.Bool(active), sampler),
            lambda t, slab, kept, going, draws: going,
            step,
            label="residual transmittance",
        )[2]

    def _of_walk(self, table: Any, at: Any, channel: Any, size: int = 0, active: Any = True) -> Any:
        """Look up a number that the bands of a walk share."""
        at = at if self.shares_walks else at + channel * (size or self._slabs)
        return self._dr.gather(self._mi.Float, table, at, active)

    def _of_bands(self, table: Any, at: Any, size: int, channel: Any, active: Any = True) -> Any:
        """Look up a number of each band, or of the walk's only band."""
        mi, dr = self._mi, self._dr
        if not self.shares_walks:
            return mi.Spectrum(dr.gather(mi.Float, table, at + channel * size, active))
        return mi.Spectrum(
            *(dr.gather(mi.Float, table, at + k * size, active) for k in range(self.bands))
        )

    def _voxel(self, p: Any) -> Any:
        mi, dr = self._mi, self._dr
        cell = (p - self._low) * self._per_mm
        nz, ny, nx = self._shape
        x, y, z = (
            mi.UInt32(dr.clip(part, 0.0, count - 0.5))
            for part, count in ((cell.x, nx), (cell.y, ny), (cell.z, nz))
        )
        return (z * ny + y) * nx + x

    def _excess(self, voxel: Any, slab: Any, channel: Any, active: Any) -> Any:
        """Return sigma_a over the slab's minimum."""
        if self._absorption is None:
            return self._mi.Spectrum(0.0)
        found = self._of_bands(self._absorption, voxel, self._voxels, channel, active)
        return self._dr.maximum(found - self.control(slab, channel), 0.0)

    def _check_lookup(self, medium: Any, low: Float64Array, high: Float64Array) -> None:
        """Refuse a grid that Mitsuba reads otherwise: rotated, or interpolated."""
        mi, dr = self._mi, self._dr
        if self._absorption is None:
            return
        rng = np.random.default_rng(0)
        points = low[:, None] + (high - low)[:, None] * rng.uniform(0.0, 1.0, (3, N_LOOKUP_CHECKS))
        interaction = dr.zeros(mi.MediumInteraction3f, N_LOOKUP_CHECKS)
        interaction.p = mi.Point3f(points.astype(np.float32))
        scattering, _, extinction = medium.get_scattering_coefficients(interaction)
        voxel = self._voxel(interaction.p)
        for band, expected in enumerate(extinction - scattering):
            found = dr.gather(mi.Float, self._absorption, voxel + band * self._voxels).numpy()
            near = np.isclose(found, expected.numpy(), rtol=1e-3, atol=1e-4 * found.max())
            if np.count_nonzero(~near) > N_BORDER_CHECKS:
                raise RenderError(
                    "tissue: gridvolume: got values that Mitsuba reads elsewhere, expected an "
                    "axis-aligned grid; set filter_type to nearest, and do not rotate it"
                )


N_LOOKUP_CHECKS: Final = 256
N_BORDER_CHECKS: Final = 2
"""Points so close to a voxel's face that rounding may place them on either side."""


def _read_grids(
    mi: Any, medium: Any
) -> tuple[Float64Array, Float64Array, Float64Array, Float64Array]:
    """Return sigma_t and albedo, shape (nz, ny, nx, bands), and the corners of the grid."""
    parameters = mi.traverse(medium)
    bands = len(mi.Spectrum(0.0))
    scale = float(np.ravel(parameters["scale"])[0]) if "scale" in parameters else 1.0
    grids, boxes = [], []
    for name in ("sigma_t", "albedo"):
        if f"{name}.data" in parameters:
            box = parameters.properties[f"{name}.data"][2].bbox()
            grid = np.array(parameters[f"{name}.data"].numpy(), np.float64)
            corners = np.array([np.ravel(box.min), np.ravel(box.max)], np.float64)
            boxes.append((corners, grid.shape[:3]))
        elif f"{name}.value.value" in parameters:
            grid = np.ravel(parameters[f"{name}.value.value"].numpy()).astype(np.float64)
            grid = grid.reshape(1, 1, 1, -1)
        else:
            raise RenderError(
                f"tissue: {name}: got {sorted(parameters.keys())}, expected a gridvolume "
                "or a number"
            )
        if grid.shape[-1] not in (1, bands):
            raise RenderError(
                f"tissue: {name}: got {grid.shape[-1]} channels, expected 1 or {bands}"
            )
        grids.append(np.broadcast_to(grid, (*grid.shape[:3], bands)))
    if len(boxes) == 2:
        (first, shape), (second, other) = boxes
        if shape != other or not np.array_equal(first, second):
            raise RenderError(
                f"tissue: grids of sigma_t and albedo: got {first.tolist()} {shape} and "
                f"{second.tolist()} {other}, expected the same place and shape"
            )
    low, high = boxes[0][0] if boxes else np.array([[-1.0] * 3, [1.0] * 3])
    sigma_t, albedo = np.broadcast_arrays(*grids)
    return scale * sigma_t, albedo, low, high
