//@chunk scatter_source_fragment
uniform float u_pre;
in vec2 v_uv;
layout(location = 0) out vec4 o_source;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec3 light = texel_irradiance(at).rgb;
  o_source = vec4(light * pow(texel_albedo(at).rgb, vec3(u_pre)), texel_albedo(at).a);
}
//@chunk scatter_fragment
// One direction of one Gaussian, as tests/twins/screen_scattering.py defines it: taps are as far apart as
// the slant of the surface makes them on the screen, and count less where they leave its plane.
uniform sampler2D u_source;
uniform ivec2 u_axis;     // one pixel along the direction
uniform float u_sigma_mm;
uniform float u_pixels;   // pixels of 1 mm at a depth of 1 mm
layout(location = 0) out vec4 o_scattered;
float depthAt(ivec2 at) {
  ivec2 size = textureSize(u_source, 0);
  return texel_irradiance(clamp(at, ivec2(0), size - 1)).a;
}
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  float depth = depthAt(at);
  if (depth <= 0.0) { o_scattered = vec4(0.0); return; }
  float before = depthAt(at - u_axis);
  float after = depthAt(at + u_axis);
  float pixel_mm = depth / u_pixels;
  float slant = SLANT_LIMIT * pixel_mm;
  if (before > 0.0) slant = min(slant, abs(depth - before));
  if (after > 0.0) slant = min(slant, abs(after - depth));
  if (before <= 0.0 && after <= 0.0) slant = 0.0;
  float sigma_mm = u_sigma_mm * texel_specular(at).a;
  float wide = sigma_mm / length(vec2(pixel_mm, slant));
  // taps are interpolated between pixels, which blurs by itself
  float sigma = wide * wide / sqrt(sqrt(wide * wide * wide * wide + INTERPOLATION));
  vec3 sum = texelFetch(u_source, at, 0).rgb;
  float weight = 1.0;
  vec2 texel = 1.0 / vec2(textureSize(u_source, 0));
  vec2 middle = vec2(at) + 0.5;
  for (int i = 1; i <= TAPS; i++) {
    float t = REACH * float(i) / float(TAPS);
    for (int side = -1; side <= 1; side += 2) {
      vec2 there = middle + float(side) * t * sigma * vec2(u_axis);
      ivec2 nearest = ivec2(floor(there));
      float other = depthAt(nearest);
      float steps = abs(float((nearest.x - at.x) * u_axis.x + (nearest.y - at.y) * u_axis.y));
      float off = max(abs(other - depth) - slant * steps, 0.0) / sigma_mm;
      vec4 found = texture(u_source, there * texel);
      float w = other > 0.0 && found.a > 1e-3 ? exp(-0.5 * (t * t + off * off)) : 0.0;
      sum += w * found.rgb / max(found.a, 1e-3);
      weight += w;
    }
  }
  o_scattered = vec4(sum / weight, 1.0);
}
//@chunk radiance_fragment
uniform float u_post;
uniform vec3 u_weights[LEVELS];
layout(location = 0) out vec4 o_radiance;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec4 albedo = texel_albedo(at);
  vec3 light = vec3(0.0);
SUM
  o_radiance = vec4(light * pow(albedo.rgb, vec3(u_post)) + texel_specular(at).rgb, albedo.a);
}
