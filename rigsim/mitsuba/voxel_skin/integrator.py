"""Integrator `tissue`: voxel skin below a boundary, lit through it by connections to the lights."""

from typing import Any, Final, NamedTuple

from rigsim.mitsuba.render_error import RenderError
from rigsim.mitsuba.voxel_skin.boundary import find_safe_box, read_boundary
from rigsim.mitsuba.voxel_skin.medium import FAR_MM, VoxelMedium

MAX_ROULETTE_WEIGHT: Final = 0.2
"""Path weight below which the roulette decides."""
CONNECTION_GAIN: Final = 10.0
"""Connections whose transmittance is below the inverse are made by chance."""
LIGHT_STEPS: Final = 4
"""Steps to the point of a flat boundary where light enters. Each divides its error by the light's
distance over the depth: 1e-8 after four at 1/100."""


def define_tissue(mi: Any) -> None:
    """Register the integrator ``tissue`` for the active variant of Mitsuba.

    The scene has one shape with an interior medium (see `rigsim.mitsuba.voxel_skin.medium`); its
    mean plane is normal to z. Its BSDF is ``roughdielectric``, or, if flat, ``dielectric`` or
    ``null``. Other shapes, such as opaque walls, have no medium. Lights are above, of any kind and
    number.

    Properties: ``max_depth`` (collisions and surface hits per path, -1: unlimited). The image has
    the whole radiance; channels ``subsurface.*`` have the part with a collision inside.

    Notes
    -----
    Each collision is connected to one light, chosen at random. At a rough boundary a normal is
    drawn, the light's direction is refracted by it, and a ray in this direction finds the exit
    point, where the BSDF is evaluated toward the light as it is seen from there: without bias for
    any relief and finite lights. At a flat smooth boundary the refracted connection is solved by
    iteration, and its spread is exact. Lights are found by connections only, so that their mirror
    images in a smooth boundary are absent. Polarized variants are not supported.

    Examples
    --------
    >>> from rigsim.mitsuba.startup import load_mitsuba
    >>> from rigsim.mitsuba.variant import choose_variant
    >>> mi = load_mitsuba(choose_variant("mono"))
    >>> mi.load_dict({"type": "tissue"}).aov_names()
    ['subsurface.Y']
    """
    from mitsuba.python.ad.integrators.common import ADIntegrator

    class TissueIntegrator(ADIntegrator):
        """Walk from the camera; see `define_tissue`."""

        def __init__(self, props: Any) -> None:
            props["max_depth"] = props.get("max_depth", -1)
            super().__init__(props)

        def aov_names(self) -> list[str]:
            return [f"subsurface.{name}" for name in ("Y" if mi.is_monochromatic else "RGB")]

        def sample(
            self, mode: Any, scene: Any, sampler: Any, ray: Any, active: Any = True, **unused: Any
        ) -> tuple[Any, Any, list[Any], Any]:
            del mode, unused
            walk = TissueWalk(mi, scene)
            surface, subsurface = walk.radiance(ray, sampler, active, self.max_depth)
            valid = mi.Bool(True)
            return surface + subsurface, valid, list(subsurface), None

        def to_string(self) -> str:
            return f"TissueIntegrator[max_depth = {self.max_depth}]"

    mi.register_integrator("tissue", lambda props: TissueIntegrator(props))


class PathState(NamedTuple):
    """Variables of the loop over events, one lane per path."""

    o: Any  # position, mm
    origin: Any  # origin of rays: off the surface just met
    d: Any  # direction
    weight: Any  # weight of each band
    inside: Any  # in the medium
    slab: Any  # slab of the medium
    collided: Any  # had a collision
    depth: Any  # collisions and surface hits
    surface: Any  # radiance of paths without a collision
    subsurface: Any  # radiance of paths with one
    active: Any  # not ended
    sampler: Any


class TissueWalk:
    """Walks in one scene.

    Parameters
    ----------
    mi
        Mitsuba with the active variant.
    scene
        As for `register`.

    Raises
    ------
    RenderError
        The scene has not one shape with an interior medium, its boundary is not supported, or the
        variant is polarized.
    """

    def __init__(self, mi: Any, scene: Any) -> None:
        import drjit as dr

        if mi.is_polarized or mi.is_spectral:
            raise RenderError(
                f"tissue: variant: got {mi.variant()}, expected one of rgb or mono; choose it"
            )
        filled = [shape for shape in scene.shapes() if shape.interior_medium() is not None]
        if len(filled) != 1:
            raise RenderError(
                f"tissue: shapes with an interior medium: got {len(filled)}, expected 1"
            )
        self._mi, self._dr, self._scene = mi, dr, scene
        self._boundary = read_boundary(mi, filled[0])
        self._medium = VoxelMedium(mi, filled[0].interior_medium())
        self._safe_low, self._safe_high = find_safe_box(mi, scene, self._boundary)
        self._far_lights = all(
            mi.has_flag(light.flags(), mi.EmitterFlags.Infinite)
            or light.class_name() == "DirectionalEmitter"
            for light in scene.emitters()
        )

    def radiance(self, ray: Any, sampler: Any, active: Any, max_depth: int) -> tuple[Any, Any]:
        """Return the radiance of paths without and with a collision."""
        mi, dr = self._mi, self._dr
        bands = self._medium.bands
        channel = mi.UInt32(0)
        start = mi.Spectrum(1.0)
        if not self._medium.shares_walks:
            channel = dr.minimum(mi.UInt32(sampler.next_1d(active) * bands), bands - 1)
            start = mi.Spectrum(
                *(dr.select(channel == k, mi.Float(bands), 0.0) for k in range(bands))
            )
        state = PathState(
            o=mi.Point3f(ray.o),
            origin=mi.Point3f(ray.o),
            d=mi.Vector3f(ray.d),
            weight=start,
            inside=mi.Bool(False),
            slab=mi.UInt32(0),
            collided=mi.Bool(False),
            depth=mi.UInt32(0),
            surface=mi.Spectrum(0.0),
            subsurface=mi.Spectrum(0.0),
            active=mi.Bool(active),
            sampler=sampler,
        )
        done = PathState(
            *dr.while_loop(
                tuple(state),
                lambda *state: PathState(*state).active,
                lambda *state: tuple(self._step(PathState(*state), channel, max_depth)),
                label="tissue",
            )
        )
        return done.surface, done.subsurface

    def _step(self, path: PathState, channel: Any, max_depth: int) -> PathState:
        """Advance to the next event: a surface, a slab's face, a collision, or a null event."""
        mi, dr, medium = self._mi, self._dr, self._medium
        o, origin, d, weight, inside, slab = path[:6]
        collided, depth, surface, subsurface, active, sampler = path[6:]
        rate = dr.maximum(medium.event_rate(slab, channel), 1.0 / FAR_MM)
        free = -dr.log(1.0 - sampler.next_1d(active)) / rate
        face = medium.face_ahead(o.z, d.z, slab)
        ahead = dr.select(inside, dr.minimum(free, face), dr.inf)
        ray = mi.Ray3f(origin, d)
        ray.maxt = ahead
        trace = active & (~inside | (ahead > self._safe_distance(o, d)))
        found = self._scene.ray_intersect_preliminary(ray, active=trace)
        hit = trace & found.is_valid()
        active &= inside | hit
        si = found.compute_surface_interaction(ray, mi.RayFlags.All, hit)
        t = dr.select(hit, si.t, ahead)
        weight = dr.select(
            inside & active, weight * dr.exp(-medium.control(slab, channel) * t), weight
        )
        moved = inside & active & ~hit
        o = dr.select(moved, dr.fma(d, t, o), dr.select(hit, si.p, o))
        crossing = moved & (face <= free)
        event = moved & ~crossing
        chance, kept = medium.choose_event(o, slab, channel, event)
        scatters = event & (sampler.next_1d(event) < chance)
        weight = dr.select(event & ~scatters, weight * kept, weight)
        slab = dr.select(crossing, medium.next_slab(slab, d.z), slab)
        collided |= scatters

        vertex = scatters | hit
        here = path._replace(o=o, weight=weight, slab=slab, sampler=sampler)
        light = self._connect(here, si, scatters, vertex, channel)
        subsurface += dr.select(collided, light, 0.0)
        surface += dr.select(collided, 0.0, light)

        turned, scale, crosses, si_origin = self._turn(o, d, si, sampler, scatters, hit)
        origin = dr.select(hit, si_origin, dr.select(moved, o, origin))
        d = dr.select(vertex, turned, d)
        weight = dr.select(vertex, weight * scale, weight)
        inside ^= hit & crosses
        slab = dr.select(hit, medium.slab(o.z), slab)
        depth += dr.select(vertex, mi.UInt32(1), mi.UInt32(0))
        active &= (depth < max_depth) & (dr.max(weight) > 0.0)
        weight, active = self._roulette(weight, inside, vertex & active, active, sampler)
        return PathState(
            o,
            origin,
            d,
            weight,
            inside,
            slab,
            collided,
            depth,
            surface,
            subsurface,
            active,
            sampler,
        )

    def _safe_distance(self, o: Any, d: Any) -> Any:
        """Return the distance that is free of surfaces; 0 outside of the box."""
        dr = self._dr
        distance = self._mi.Float(FAR_MM)
        for x, dx, low, high in zip(o, d, self._safe_low, self._safe_high, strict=True):
            gap = dr.select(dx > 0.0, high - x, x - low)
            distance = dr.minimum(distance, gap / dr.maximum(dr.abs(dx), 1e-12))
        return dr.maximum(distance, 0.0)

    def _turn(
        self, o: Any, d: Any, si: Any, sampler: Any, scatters: Any, hit: Any
    ) -> tuple[Any, Any, Any, Any]:
        """Draw the next direction; also return its weight and whether it crosses the boundary."""
        mi, dr = self._mi, self._dr
        one, two = sampler.next_1d(scatters | hit), sampler.next_2d(scatters | hit)
        context = mi.PhaseFunctionContext(sampler)
        phase_d, phase_weight, _ = self._medium.phase.sample(
            context, self._interaction(o, d), one, two, scatters
        )
        bs, bsdf_weight = si.bsdf().sample(mi.BSDFContext(), si, one, two, hit)
        surface_d = si.to_world(bs.wo)
        crosses = self._is_boundary(si) & (dr.dot(si.n, surface_d) * dr.dot(si.n, d) > 0.0)
        turned = dr.normalize(dr.select(scatters, phase_d, surface_d))
        scale = dr.select(scatters, mi.Spectrum(phase_weight), bsdf_weight)
        return turned, scale, crosses, si.spawn_ray(surface_d).o

    def _roulette(
        self, weight: Any, inside: Any, plays: Any, active: Any, sampler: Any
    ) -> tuple[Any, Any]:
        """End light paths by chance; inside, radiance is divided by eta^2."""
        dr = self._dr
        importance = dr.max(weight) * dr.select(inside, self._boundary.eta**2, 1.0)
        if not self._medium.shares_walks:
            importance /= self._medium.bands
        survival = dr.clip(importance / MAX_ROULETTE_WEIGHT, 0.05, 1.0)
        dies = plays & (sampler.next_1d(plays) >= survival)
        return dr.select(plays, weight / survival, weight), active & ~dies

    def _is_boundary(self, si: Any) -> Any:
        return si.is_medium_transition()

    def _interaction(self, p: Any, d: Any) -> Any:
        """Return the interaction of a phase function."""
        mi, dr = self._mi, self._dr
        made = dr.zeros(mi.MediumInteraction3f)
        made.p, made.wi, made.t = p, -d, mi.Float(0.0)
        made.sh_frame = mi.Frame3f(-d)
        return made

    def _connect(self, path: PathState, si: Any, scatters: Any, vertex: Any, channel: Any) -> Any:
        """Return the light of one emitter at a vertex: direct outside, refracted from inside."""
        mi, dr, boundary = self._mi, self._dr, self._boundary
        o, d, inside, sampler = path.o, path.d, path.inside, path.sampler
        choice, normal_sample = sampler.next_2d(vertex), sampler.next_2d(vertex)
        below = vertex & inside
        toward, inverse_pdf = (
            self._rough_direction(o, choice, normal_sample, below)
            if boundary.is_rough
            else self._smooth_direction(o, choice, below)
        )
        depth = self._medium.control_depth(o.z, channel)
        at_plane = self._medium.control_depth(mi.Float(boundary.height), channel)
        steep = dr.maximum(dr.abs(toward.z), 1e-6)
        guess = dr.max(dr.exp(dr.minimum(at_plane - depth, 0.0) / steep))
        chance = dr.minimum(1.0, CONNECTION_GAIN * dr.maximum(guess, 1e-6))
        made = below & (inverse_pdf > 0.0) & (sampler.next_1d(below) < chance)
        made &= scatters | (dr.dot(si.n, toward) * dr.dot(si.n, d) < 0.0)

        start = dr.select(scatters, o, si.spawn_ray(toward).o)
        exit_si = self._scene.ray_intersect(mi.Ray3f(start, toward), made)
        made &= exit_si.is_valid() & self._is_boundary(exit_si)
        response = dr.select(
            scatters,
            mi.Spectrum(
                self._medium.phase.eval_pdf(
                    mi.PhaseFunctionContext(sampler), self._interaction(o, d), toward, scatters
                )[0]
            ),
            si.bsdf().eval(mi.BSDFContext(), si, si.to_local(toward), made & ~scatters),
        )
        span = self._medium.control_depth(exit_si.p.z, channel) - depth
        through = dr.exp(-dr.abs(span) / dr.maximum(dr.abs(toward.z), 1e-6))
        through *= self._medium.residual_transmittance(
            o, toward, exit_si.t, path.slab, channel, sampler, made
        )
        through = response * through * (inverse_pdf / chance)

        # From here on both kinds of vertices are points of a surface, seen from wi.
        open_vertex = vertex & ~inside
        last = dr.select(open_vertex, si, exit_si)
        lit = made | open_vertex
        ds, emitted = self._scene.sample_emitter_direction(last, choice, False, lit)
        lit &= ds.pdf > 0.0
        reflected = last.bsdf().eval(mi.BSDFContext(), last, last.to_local(ds.d), lit)
        if not boundary.is_rough:
            smooth = self._smooth_entry(ds, dr.dot(toward, exit_si.n), exit_si)
            reflected = dr.select(open_vertex, reflected, mi.Spectrum(smooth))
        lit &= dr.max(reflected) > 0.0
        lit &= ~self._scene.ray_test(last.spawn_ray_to(ds.p), lit)
        light = (
            path.weight * dr.select(open_vertex, mi.Spectrum(1.0), through) * reflected * emitted
        )
        return dr.select(lit, light, 0.0)

    def _rough_direction(self, o: Any, choice: Any, sample: Any, active: Any) -> tuple[Any, Any]:
        """Refract the light's direction by a drawn normal; also return 1 / pdf of the result.

        The pdf is by Walter et al. 2007, doi:10.2312/EGWR/EGSR07/195-206, eq. 17.
        """
        mi, dr = self._mi, self._dr
        light, _ = self._light_from(o, choice, active)
        m, pdf = self._boundary.facets.sample(mi.Vector3f(0.0, 0.0, 1.0), sample)
        eta = self._boundary.eta
        cos_l = dr.dot(light.d, m)
        cos_t = dr.sqrt(dr.maximum(1.0 - (1.0 - cos_l * cos_l) / eta**2, 0.0))
        toward = light.d / eta + (cos_t - cos_l / eta) * m
        half = eta * cos_t - cos_l
        density = pdf * eta**2 * cos_t / (half * half)
        usable = active & (cos_l > 0.0) & (density > 0.0) & (light.pdf > 0.0)
        return dr.normalize(toward), dr.select(usable, 1.0 / density, 0.0)

    def _smooth_direction(self, o: Any, choice: Any, active: Any) -> tuple[Any, Any]:
        """Find the direction that a flat boundary refracts to the light."""
        mi, dr, eta = self._mi, self._dr, self._boundary.eta
        entry = mi.Point3f(o.x, o.y, self._boundary.height)
        for _ in range(1 if self._far_lights else LIGHT_STEPS):
            light, _ = self._light_from(entry, choice, active)
            cos_l = light.d.z
            cos_t = dr.sqrt(dr.maximum(1.0 - (1.0 - cos_l * cos_l) / eta**2, 0.0))
            toward = mi.Vector3f(light.d.x / eta, light.d.y / eta, cos_t)
            entry = o + toward * ((self._boundary.height - o.z) / cos_t)
        usable = active & (cos_l > 0.0) & (light.pdf > 0.0)
        return toward, dr.select(usable, mi.Float(1.0), 0.0)

    def _light_from(self, p: Any, choice: Any, active: Any) -> tuple[Any, Any]:
        seen = self._dr.zeros(self._mi.Interaction3f)
        seen.p = p
        return self._scene.sample_emitter_direction(seen, choice, False, active)

    def _smooth_entry(self, ds: Any, cos_t: Any, si: Any) -> Any:
        """Return irradiance inside over that of the emitter, both across the beam.

        A beam of a finite light spreads otherwise inside: its width along and across the plane of
        incidence grows by (r + s / eta) and (r + s cos_l^2 / (eta cos_t^2)) over r.
        """
        mi, dr, eta = self._mi, self._dr, self._boundary.eta
        cos_l = dr.dot(ds.d, si.n)
        reflectance = mi.fresnel(cos_l, mi.Float(eta))[0] if eta != 1.0 else mi.Float(0.0)
        entry = (1.0 - reflectance) * cos_l / dr.maximum(cos_t, 1e-6)
        if not self._far_lights:
            far = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
            part = dr.select(far, 0.0, si.t / (eta * ds.dist))
            entry /= (1.0 + part) * (1.0 + part * cos_l * cos_l / (cos_t * cos_t))
        return dr.select(cos_l > 0.0, entry, 0.0)
