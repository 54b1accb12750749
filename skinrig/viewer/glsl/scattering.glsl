//@chunk scatter_source_fragment
uniform float u_pre;
in vec2 v_uv;
layout(location = 0) out vec4 o_source;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec3 light = texel_irradiance(at).rgb;
  o_source = vec4(light * pow(texel_albedo(at).rgb, vec3(u_pre)), 1.0);
}
//@chunk scatter_fragment
// One direction of one Gaussian; a tap counts by its distance in space, so that light does not
// leak across depths.
uniform sampler2D u_source;
uniform vec2 u_step;      // texture coordinates of one pixel along the direction
uniform float u_sigma_mm;
uniform float u_pixels;   // pixels of 1 mm at a depth of 1 mm
in vec2 v_uv;
layout(location = 0) out vec4 o_scattered;
void main() {
  float depth = texel_irradiance(ivec2(gl_FragCoord.xy)).a;
  vec4 middle = texture(u_source, v_uv);
  if (depth <= 0.0) { o_scattered = vec4(0.0); return; }
  float sigma = u_sigma_mm * u_pixels / depth;
  vec3 sum = middle.rgb;
  float weight = 1.0;
  for (int i = 1; i <= TAPS; i++) {
    float t = 3.0 * float(i) / float(TAPS);
    for (int side = -1; side <= 1; side += 2) {
      vec2 at = v_uv + float(side) * t * sigma * u_step;
      float there = buffer_irradiance(at).a;
      float away = (there - depth) / u_sigma_mm;
      float w = there > 0.0 ? exp(-0.5 * (t * t + away * away)) : 0.0;
      sum += w * texture(u_source, at).rgb;
      weight += w;
    }
  }
  o_scattered = vec4(sum / weight, 1.0);
}
//@chunk radiance_fragment
uniform float u_post;
in vec2 v_uv;
layout(location = 0) out vec4 o_radiance;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec4 albedo = texel_albedo(at);
  vec3 light = vec3(0.0);
SUM
  o_radiance = vec4(light * pow(albedo.rgb, vec3(u_post)) + texel_specular(at).rgb, albedo.a);
}
