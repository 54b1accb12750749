//@chunk hair_place
// On the image, with the depth of a point that is nearer by a tolerance: skin there does not hide it.
uniform mat4 u_view;
uniform mat4 u_projection;
vec4 hairPlace(vec3 position, float tolerance_mm) {
  vec4 seen = u_view * vec4(position, 1.0);
  vec4 place = u_projection * seen;
  vec4 nearer = u_projection * (seen + vec4(0.0, 0.0, tolerance_mm, 0.0));
  return vec4(place.xy, nearer.z / nearer.w * place.w, place.w);
}
//@chunk undercoat_vertex
in vec2 a_coverage;  // of the scalp's hair, and of brows
out vec2 v_coverage;
void main() {
  passAttributes();
  v_coverage = a_coverage;
  gl_Position = hairPlace(a_position, 0.4);
}
//@chunk undercoat_fragment
uniform vec3 u_to_light;
uniform vec3 u_light_center;
uniform vec3 u_multiple;
uniform vec2 u_shown;
in vec2 v_coverage;
layout(location = 0) out vec4 o_hair;
void main() {
  vec2 shown = v_coverage * u_shown;
  float covered = max(shown.x, shown.y);
  if (covered < 0.01) discard;
  vec3 normal = normalize(v_normal);
  float direct = clamp(dot(normal, u_to_light), 0.0, 1.0);
  vec3 light = vec3(0.6 * p_light_intensity * direct + p_ambient * (0.5 + 0.3 * normal.y));
  for (int i = 0; i < FURTHER; i++) {
    light += 0.6 * furtherIntensity(i, v_position - u_light_center) * clamp(dot(normal, u_further_to[i]), 0.0, 1.0);
  }
#if SURROUNDED
  light += 0.6 * environmentIrradiance(normal);
#endif
  o_hair = vec4(covered * light * (u_multiple + 0.004), covered);
}
//@chunk hair_light
// Share of the key light at a curve: few comparisons above the skin of its root.
uniform vec3 u_light_center;
uniform vec3 u_light_right;
uniform vec3 u_light_up;
uniform vec3 u_light_to;
uniform float u_light_scale;
float hairLit(vec3 position) {
#if SHADOWED
  vec3 from = position - u_light_center;
  float height = dot(from, u_light_to);
  vec2 at = vec2(dot(from, u_light_right), dot(from, u_light_up)) * u_light_scale + 0.5;
  float sum = 0.0;
  for (int i = 0; i < 4; i++) {
    vec2 there = at * p_shadow_px + 2.0 * vec2(float(i & 1) - 0.5, float(i >> 1) - 0.5);
    ivec2 texel = clamp(ivec2(there), ivec2(0), ivec2(int(p_shadow_px) - 1));
    sum += clamp(1.0 - (texel_shadow_depth(texel).r - height - 2.5) / 5.0, 0.0, 1.0);
  }
  return 0.25 * sum;
#else
  return 1.0;
#endif
}
//@chunk hair_vertex
uniform vec3 u_eye;
uniform float u_pixels;
in vec3 a_position;
in vec3 a_tangent;
in vec3 a_normal;
in vec4 a_fiber;  // side, 0 at the root to 1 at the tip, seed, width mm (negative: a lock)
out vec3 v_position;
out vec3 v_tangent;
out vec3 v_normal;
out vec4 v_fiber;
out float v_lit;
void main() {
  float width = abs(a_fiber.w);
  bool lock = a_fiber.w < 0.0;
  float taper = lock ? 1.0 - 0.75 * a_fiber.y * a_fiber.y : 1.0 - 0.85 * a_fiber.y;
  float depth = -(u_view * vec4(a_position, 1.0)).z;
  float pixel = depth / u_pixels;
  float half_mm = 0.5 * width * taper;
  float drawn = max(half_mm, 0.55 * pixel);
  vec3 to_eye = normalize(u_eye - a_position);
  vec3 across = normalize(cross(a_tangent, to_eye));
  v_position = a_position + a_fiber.x * drawn * across;
  v_tangent = a_tangent;
  v_normal = a_normal;
  v_fiber = vec4(a_fiber.xyz, lock ? -half_mm / drawn : half_mm / drawn);
  v_lit = hairLit(a_position);
  gl_Position = hairPlace(v_position, 0.6);
}
//@chunk hair_fragment
// Marschner et al. 2003 (doi 10.1145/882262.882345): reflection R, transmission TT and inner
// reflection TRT with Gaussian longitudinal lobes; absorption as in d'Eon et al. 2011; multiple
// scattering as the diffuse term of Kajiya and Kay 1989 with the albedo of Chiang et al. 2016.
uniform vec3 u_eye;
uniform vec3 u_to_light;
uniform vec3 u_light_center;
uniform vec3 u_absorption;
uniform vec3 u_multiple;
in vec3 v_position;
in vec3 v_tangent;
in vec3 v_normal;
in vec4 v_fiber;
in float v_lit;
layout(location = 0) out vec4 o_hair;
float lobe(float x, float width) { return exp(-0.5 * x * x / (width * width)) / (2.5066 * width); }
float hashed(vec2 at) { return fract(sin(dot(at, vec2(127.1, 311.7))) * 43758.5453); }
struct Strand { vec3 along; vec3 toEye; vec3 normal; float shade; };
vec3 insideAt(float cos_i) { return exp(-1.6 * u_absorption / max(cos_i, 0.3)); }
vec3 diffuseOf(vec3 inside) { return u_multiple + 0.15 * inside * inside * inside; }
// Radiance by one light, of its intensity after shadows.
vec3 strandFrom(Strand s, float intensity, vec3 light) {
  float sin_i = dot(s.along, light);
  float sin_r = dot(s.along, s.toEye);
  float cos_i = sqrt(max(1.0 - sin_i * sin_i, 0.0));
  vec3 light_flat = light - sin_i * s.along;
  vec3 eye_flat = s.toEye - sin_r * s.along;
  float cos_phi = dot(light_flat, eye_flat) / max(length(light_flat) * length(eye_flat), 1e-3);
  float half_cos = sqrt(clamp(0.5 + 0.5 * cos_phi, 0.0, 1.0));
  float sum = sin_i + sin_r;
  float base = 1.0 - sqrt(clamp(0.5 + 0.5 * dot(light, s.toEye), 0.0, 1.0));
  float fresnel = 0.046 + 0.954 * base * base * base * base * base;
  vec3 inside = insideAt(cos_i);
  vec3 direct = vec3(lobe(sum + 0.12, 0.16) * 0.25 * half_cos * fresnel)
    + lobe(sum - 0.06, 0.08) * exp(-3.65 * cos_phi - 3.98) * inside * 0.9
    + lobe(sum - 0.18, 0.30) * exp(17.0 * cos_phi - 16.78) * inside * inside * 0.9 * fresnel * 4.0;
  float facing = clamp((dot(s.normal, light) + 0.35) / 1.35, 0.0, 1.0);
  return intensity * facing * s.shade * (PI * direct * cos_i + diffuseOf(inside) * cos_i);
}
// Radiance by the environment: the diffuse term, and R and TRT as the light around the direction that
// mirrors the eye, times their integrals over directions. Other hair hides what TT transmits.
vec3 strandSurrounded(Strand s) {
  float sin_r = dot(s.along, s.toEye);
  vec3 inside = insideAt(0.25 * PI);  // mean cosine of uniform directions
  vec3 mirrored = -s.toEye + 2.0 * (s.toEye - sin_r * s.along);
  vec3 lobes = (1.0 - sin_r * sin_r) * (0.07 + 0.13 * inside * inside);
  return s.shade * (diffuseOf(inside) * environmentIrradiance(s.normal) + lobes * environmentIrradiance(mirrored));
}
void main() {
  bool lock = v_fiber.w < 0.0;
  float alpha = abs(v_fiber.w);
  float tone = 1.0;
  if (lock) {
    // about nine strands across a lock, thinner towards the tip
    float strand = 4.5 * v_fiber.x + 40.0 * v_fiber.z;
    float cell = floor(strand);
    float reach = 0.55 + 0.45 * hashed(vec2(cell, v_fiber.z));
    alpha *= smoothstep(0.0, 0.12, reach - v_fiber.y) * (0.55 + 0.45 * (1.0 - abs(2.0 * (strand - cell) - 1.0)));
    tone = 0.75 + 0.5 * hashed(vec2(cell, v_fiber.z + 0.37));
  } else {
    alpha *= 1.0 - smoothstep(0.85, 1.0, v_fiber.y);
  }
  // hair around a strand hides its root
  float depth_shade = lock ? mix(0.25, 1.0, smoothstep(0.0, 0.8, v_fiber.y)) : 0.55;
  Strand s = Strand(normalize(v_tangent), normalize(u_eye - v_position), normalize(v_normal), depth_shade);
  float sin_key = dot(s.along, u_to_light);
  vec3 inside = insideAt(sqrt(max(1.0 - sin_key * sin_key, 0.0)));
  vec3 light = strandFrom(s, p_light_intensity * v_lit, u_to_light)
    + p_ambient * depth_shade * (0.6 + 0.4 * s.normal.y) * diffuseOf(inside);
  for (int i = 0; i < FURTHER; i++) {
    light += strandFrom(s, furtherIntensity(i, v_position - u_light_center), u_further_to[i]);
  }
#if SURROUNDED
  light += strandSurrounded(s);
#endif
  o_hair = vec4(alpha * tone * light, alpha);
}
