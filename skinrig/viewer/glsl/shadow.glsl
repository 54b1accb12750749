//@chunk light_vertex
uniform vec3 u_light_center;
uniform vec3 u_light_right;
uniform vec3 u_light_up;
uniform vec3 u_light_to;
uniform float u_light_scale;
out float v_height;
void main() {
  passAttributes();
  vec3 from = a_position - u_light_center;
  v_height = dot(from, u_light_to);
  gl_Position = vec4(2.0 * u_light_scale * vec3(dot(from, u_light_right), dot(from, u_light_up),
    -v_height), 1.0);
}
//@chunk shadow_fragment
in float v_height;
layout(location = 0) out vec4 o_height;
void main() { o_height = vec4(v_height, 0.0, 0.0, 1.0); }
//@chunk shadow_lookup
// Share of the key light that reaches a point: comparisons with 5 x 5 places of the depth map, its
// outer ones counted by the point's own place between them, so that edges move smoothly. Each place
// is compared with the plane of the surface there, not with the point: a slant casts no shadow on
// itself, and little is left for a bias to do.
uniform vec3 u_light_center;
uniform vec3 u_light_right;
uniform vec3 u_light_up;
uniform vec3 u_light_to;
uniform float u_light_scale;
const float STEEPEST = 4.0;   // slope of that plane, at most
const float BIAS_MM = 0.25;   // what a surface bends within a filter, and triangles stand off it
float litShare(vec3 position, vec3 normal) {
#if SHADOWED
  float across = dot(normal, u_light_to);
  if (across <= 0.0) return 0.0;
  vec3 from = position - u_light_center;
  vec2 plane = vec2(dot(from, u_light_right), dot(from, u_light_up));
  float height = dot(from, u_light_to);
  vec2 slope = -vec2(dot(normal, u_light_right), dot(normal, u_light_up)) / across;
  slope *= min(1.0, STEEPEST / max(length(slope), 1e-6));
  float size = p_shadow_px;
  float texel_mm = 1.0 / (u_light_scale * size);
  float apart = max(1.0, floor(0.5 * p_shadow_softness_mm / texel_mm + 0.5));  // texels
  vec2 at = (plane * u_light_scale + 0.5) * size - 0.5;
  vec2 first = floor(at / apart);
  vec2 part = at / apart - first;
  float bias = BIAS_MM + 0.5 * texel_mm * apart * (1.0 + length(slope));
  float sum = 0.0;
  for (int j = -2; j <= 2; j++) {
    for (int i = -2; i <= 2; i++) {
      vec2 there = (first + vec2(i, j)) * apart;
      ivec2 texel = clamp(ivec2(there), ivec2(0), ivec2(int(size) - 1));
      float expected = height + dot(slope, (there - at) * texel_mm);
      float lit = texel_shadow_depth(texel).r > expected + bias ? 0.0 : 1.0;
      float wx = i == -2 ? 1.0 - part.x : i == 2 ? part.x : 1.0;
      float wy = j == -2 ? 1.0 - part.y : j == 2 ? part.y : 1.0;
      sum += wx * wy * lit;
    }
  }
  return sum / 16.0;
#else
  return 1.0;
#endif
}
//@chunk lit_fragment
layout(location = 0) out vec4 o_lit;
void main() { o_lit = vec4(litShare(v_position, normalize(v_normal)), 0.0, 0.0, 1.0); }
