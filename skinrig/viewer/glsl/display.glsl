//@chunk tone
vec3 srgb(vec3 linear) {
  vec3 c = clamp(linear, 0.0, 1.0);
  return mix(12.92 * c, 1.055 * pow(c, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, c));
}
// Hable's operator, tests/twins/tone_mapping.py
vec3 filmicCurve(vec3 x) {
  return (x * (0.15 * x + 0.05) + 0.004) / (x * (0.15 * x + 0.5) + 0.06) - 0.02 / 0.3;
}
vec3 filmic(vec3 linear) {
  return filmicCurve(2.0 * max(linear, 0.0)) / filmicCurve(vec3(11.2));
}
//@chunk display_fragment
in vec2 v_uv;
layout(location = 0) out vec4 o_display;
void main() {
  vec4 radiance = texel_radiance(ivec2(gl_FragCoord.xy));
#ifdef HAS_hair
  vec4 hair = texel_hair(ivec2(gl_FragCoord.xy));
  radiance = vec4(radiance.rgb * (1.0 - hair.a) + hair.rgb, radiance.a + hair.a * (1.0 - radiance.a));
#endif
  vec3 exposed = p_exposure * radiance.rgb;
  vec3 shown = srgb(p_filmic > 0.5 ? filmic(exposed) : exposed);
  o_display = vec4(mix(p_background, shown, radiance.a), 1.0);
}
//@chunk show_fragment
uniform sampler2D u_first;
uniform sampler2D u_second;
uniform float u_split;
uniform float u_low;
uniform float u_high;
uniform float u_channels;
uniform float u_difference;
in vec2 v_uv;
layout(location = 0) out vec4 o_color;
void main() {
  vec4 a = texture(u_first, v_uv);
  vec4 b = texture(u_second, v_uv);
  vec4 value = u_difference > 0.0 ? u_difference * (a - b) : v_uv.x < u_split ? a : b;
  vec3 shown = u_channels > 2.5 ? value.rgb : u_channels > 1.5 ? vec3(value.rg, 0.0) : value.rrr;
  float low = u_difference > 0.0 ? -0.5 * (u_high - u_low) : u_low;
  o_color = vec4((shown - low) / (u_high - u_low), 1.0);
}
