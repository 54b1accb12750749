//@chunk hemoglobin_rig_fragment
// Scale and bias of the mixture, Jimenez 2010 eq. (6), with the factor of all blood in both; and
// the stored mean that is taken off the neutral map.
uniform float u_weights[STATES];  // of states with a weight, which are u_layers
uniform float u_layers[STATES];
uniform int u_count;
uniform float u_gain;
in vec2 v_uv;
layout(location = 0) out vec4 o_rig;
void main() {
  vec2 mixed = vec2(0.0);
  for (int i = 0; i < u_count; i++) {
    mixed += u_weights[i] * sample_facial_states(vec3(v_uv, u_layers[i])).rg;
  }
  o_rig = vec4(u_gain * mixed, sample_facial_states(vec3(v_uv, 0.0)).g, 1.0);
}
//@chunk skin_color
// Melanin and hemoglobin are stored as cube roots of volume fractions (eq. 7).
vec2 neutralFractions(vec2 uv) {
  vec2 roots = sample_chromophores(uv).rg;
  return roots * roots * roots;
}
float melaninFraction(vec2 neutral) { return clamp(p_melanin_gain * neutral.r, 0.0, C_M_MAX); }
float blendHemoglobin(vec2 uv, float neutral) {
#ifdef HAS_facial_states
  vec3 rig = buffer_hemoglobin_rig(uv).rgb;
  neutral = rig.g + rig.r * (neutral - rig.b);
#endif
  return clamp(p_hemoglobin_gain * neutral, 0.0, C_HD_MAX);
}
vec3 skinColorOf(float melanin, float hemoglobin) {
  vec2 at = pow(vec2(hemoglobin / C_HD_MAX, melanin / C_M_MAX), vec2(1.0 / 3.0));
  return max(table_skin_color((at * (TABLE_SIZE - 1.0) + 0.5) / TABLE_SIZE).rgb, 0.0);
}
vec3 skinAlbedo(vec2 uv) {
  vec2 neutral = neutralFractions(uv);
  vec3 color = skinColorOf(melaninFraction(neutral), blendHemoglobin(uv, neutral.g));
#ifdef HAS_albedo_map
  // a measured albedo changes as the modeled color does
  color *= sample_albedo_map(uv).rgb / skinColorOf(neutral.r, neutral.g);
#endif
#ifdef HAS_albedo_factor
  color *= buffer_albedo_factor(uv).rgb;
#endif
  return color;
}
//@chunk color_uv_fragment
layout(location = 0) out vec4 o_chromophores;
layout(location = 1) out vec4 o_color;
void main() {
  vec2 neutral = neutralFractions(v_uv);
  o_chromophores = vec4(melaninFraction(neutral), blendHemoglobin(v_uv, neutral.g), neutral.g, 1.0);
  o_color = vec4(skinAlbedo(v_uv), 1.0);
}
