//@chunk wrinkle_functions
// Jimenez 2011, listing 1.1: partial derivatives n_x / n_z, n_y / n_z of the face at rest, plus each
// wrinkle map times the strength of its zones (eight in two RGBA textures; weights may be negative).
#ifndef WRINKLE_LAYERS
#define WRINKLE_LAYERS 0
#endif
vec2 wrinkleBase(vec2 uv) {
#ifdef HAS_wrinkle_base
  return sample_wrinkle_base(uv).xy;
#else
  return vec2(0.0);  // the relief at rest is drawn from its heights
#endif
}
#if WRINKLE_LAYERS > 0
uniform vec4 u_zones[2 * WRINKLE_LAYERS];
vec2 wrinkleDerivatives(vec2 uv) {
  vec2 sum = wrinkleBase(uv);
  for (int layer = 0; layer < WRINKLE_LAYERS; layer++) {
    float strength = dot(u_zones[2 * layer], sample_wrinkle_masks(vec3(uv, float(2 * layer))))
      + dot(u_zones[2 * layer + 1], sample_wrinkle_masks(vec3(uv, float(2 * layer + 1))));
    sum += p_wrinkles * strength * sample_wrinkle_maps(vec3(uv, float(layer))).xy;
  }
  return sum;
}
#else
vec2 wrinkleDerivatives(vec2 uv) { return wrinkleBase(uv); }
#endif

//@chunk wrinkle_fragment
// Derivatives and their squares: averaged over a pixel's footprint by the mip levels, they say
// which slope it shows and what variance of slopes it does not (Olano and Baker 2010).
in vec2 v_uv;
layout(location = 0) out vec4 derivatives;
void main() {
  vec2 d = wrinkleDerivatives(v_uv);
  derivatives = vec4(d, d * d);
}

//@chunk wrinkle_surface
vec4 moments;  // of this pixel, which surface_fragment asks for first
vec2 wrinkleSlope(vec2 uv) {
  moments = buffer_wrinkle_derivatives(uv);
  return -p_detail_wrinkles * moments.xy;
}

void adjustWrinkles(inout SurfacePoint s) {
  // left out: all of the slopes' squares are variance that no pixel shows
  vec2 shown = p_detail_wrinkles * moments.xy;
  vec2 variance = max(moments.zw - shown * shown, 0.0);
  // half-float moments of a single texel differ by rounding
  variance -= min(variance, moments.zw * 2e-3);
  s.roughness = sqrt(s.roughness * s.roughness + variance.x + variance.y);
  s.unseen += 0.5 * (variance.x + variance.y);
}

//@chunk hybrid_source_fragment
// Derivatives of relief at rest and wrinkles in the texture, and where the face is.
layout(location = 0) out vec4 source;
void main() {
  SurfacePoint s;
  s.uv = v_uv;
  s.normal = normalize(v_normal);
  s.tangent = normalize(v_tangent - dot(v_tangent, s.normal) * s.normal);
  s.bitangent = cross(s.normal, s.tangent);
  if (dot(s.bitangent, v_bitangent) < 0.0) s.bitangent = -s.bitangent;
  source = vec4(-staticSlope(s, v_tangent, v_bitangent) + buffer_wrinkle_derivatives(v_uv).xy,
    0.0, 1.0);
}

//@chunk soften_fragment
// Normals for diffuse light, one for each color, softened as far as light of that color travels
// within the skin (hybrid normals: Ma et al. 2007, as Nagano 2015 renders). One direction of a
// Gaussian at whole texels within 3 sigmas; texels outside of the face do not count.
uniform vec2 u_direction;     // 1 along the pass
uniform vec3 u_sigma_px;
layout(location = 0) out vec4 red_green;
layout(location = 1) out vec4 blue;

void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  ivec2 last = textureSize(b_hybrid_source, 0) - 1;
  vec4 first = vec4(0.0);
  vec2 second = vec2(0.0);
  vec3 weight = vec3(0.0);
  int radius = int(ceil(3.0 * max(u_sigma_px.x, max(u_sigma_px.y, u_sigma_px.z))));
  for (int i = -radius; i <= radius; i++) {
    ivec2 there = at + i * ivec2(u_direction);
    if (any(lessThan(there, ivec2(0))) || any(greaterThan(there, last))) continue;
    vec4 own = texel_hybrid_source(there);
    if (own.a < 0.5) continue;
    vec3 w = exp(-0.5 * float(i * i) / max(u_sigma_px * u_sigma_px, 1e-6));
#ifdef FROM_SOFTENING
    first += vec4(w.xx, w.yy) * texel_softening_red_green(there);
    second += w.z * texel_softening_blue(there).xy;
#else
    first += vec4(w.xx, w.yy) * own.xyxy;
    second += w.z * own.xy;
#endif
    weight += w;
  }
  weight = max(weight, 1e-20);
  red_green = first / vec4(weight.xx, weight.yy);
  blue = vec4(second / weight.z, 0.0, 1.0);
}

//@chunk hybrid_surface
void adjustHybridNormals(inout SurfacePoint s) {
#if HYBRID
  vec4 first = buffer_softened_red_green(s.uv);
  vec2 second = buffer_softened_blue(s.uv).xy;
  s.diffuseNormals = mat3(tilted(s, -first.xy), tilted(s, -first.zw), tilted(s, -second));
#endif
}
