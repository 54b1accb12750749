//@chunk surface_point
// What is known of the surface under a pixel; functions of V.surface.adjust may change it.
struct SurfacePoint {
  vec2 uv;
  vec3 position;
  vec3 tangent;         // orthonormal frame of the smooth surface
  vec3 bitangent;
  vec3 normal;
  vec2 slope;           // relief: change of height per length along tangent and bitangent
  mat3 diffuseNormals;  // columns: of red, green, blue
  vec3 specularNormal;
  float roughness;      // Beckmann m
  float unseen;         // variance of slopes along one axis that no pixel shows, beyond neutral skin's
  float intensity;      // of the specular reflection
  vec3 toLight;
  vec3 toEye;
};
vec3 tilted(SurfacePoint s, vec2 slope) {
  return normalize(s.normal - slope.x * s.tangent - slope.y * s.bitangent);
}
//@chunk static_relief
// Slopes of the relief at rest on the surface as it is now: stretched skin has flatter relief.
vec2 staticSlope(SurfacePoint s, vec3 du, vec3 dv) {
#ifdef HAS_relief_height
  vec2 texel = 1.0 / vec2(textureSize(t_relief_height, 0));
  float left = sample_relief_height(s.uv - vec2(texel.x, 0.0)).r;
  float right = sample_relief_height(s.uv + vec2(texel.x, 0.0)).r;
  float below = sample_relief_height(s.uv - vec2(0.0, texel.y)).r;
  float above = sample_relief_height(s.uv + vec2(0.0, texel.y)).r;
  vec2 change = 0.5e-3 * vec2(right - left, above - below) / texel;  // mm per unit of u and v
  float e = dot(du, du);
  float f = dot(du, dv);
  float g = dot(dv, dv);
  float determinant = e * g - f * f;
  if (determinant <= 1e-9 * max(e, g) * max(e, g)) return vec2(0.0);
  vec3 gradient = ((g * change.x - f * change.y) * du + (e * change.y - f * change.x) * dv)
    / determinant;
  return p_relief * vec2(dot(gradient, s.tangent), dot(gradient, s.bitangent));
#else
  return vec2(0.0);
#endif
}
//@chunk kelemen_specular
// Kelemen and Szirmay-Kalos 2001 with Beckmann's distribution and Schlick's Fresnel term.
float kelemenSpecular(SurfacePoint s, vec3 n) {
  float light = dot(n, s.toLight);
  if (light <= 0.0) return 0.0;
  vec3 whole = s.toLight + s.toEye;
  vec3 h = normalize(whole);
  float c2 = max(dot(n, h), 1e-3);
  c2 *= c2;
  float m2 = s.roughness * s.roughness;
  float density = exp((c2 - 1.0) / (c2 * m2)) / (PI * m2 * c2 * c2);
  float base = 1.0 - dot(s.toEye, h);
  float fresnel = p_f0 + (1.0 - p_f0) * base * base * base * base * base;
  return max(density * fresnel / dot(whole, whole), 0.0);
}
//@chunk further_lights
// Fill and rim light. The head as a ball: light from behind does not reach the front.
uniform vec3 u_further_to[max(FURTHER, 1)];
uniform float u_further_intensity[max(FURTHER, 1)];
float furtherIntensity(int i, vec3 from_center) {
  float raised = dot(normalize(from_center), u_further_to[i]);
  return u_further_intensity[i] * smoothstep(-0.3, 0.1, raised);
}
//@chunk environment_light
// Spherical harmonics of the environment; bands are weighted by the kernel that blurs it.
uniform vec3 u_environment[9];
vec3 environmentLight(vec3 d, vec3 bands) {
  vec3 first = u_environment[1] * d.y + u_environment[2] * d.z + u_environment[3] * d.x;
  vec3 second = 1.0925484 * (u_environment[4] * d.x * d.y + u_environment[5] * d.y * d.z
    + u_environment[7] * d.x * d.z) + 0.3153916 * u_environment[6] * (3.0 * d.z * d.z - 1.0)
    + 0.5462742 * u_environment[8] * (d.x * d.x - d.y * d.y);
  return max(bands.x * 0.2820948 * u_environment[0] + bands.y * 0.4886025 * first
    + bands.z * second, 0.0);
}
// Irradiance over pi (Ramamoorthi and Hanrahan 2001).
vec3 environmentIrradiance(vec3 n) { return environmentLight(n, vec3(1.0, 2.0 / 3.0, 0.25)); }
//@chunk environment_highlight
// A lobe of roughness m around the mirror direction blurs band l by exp(-(l m)^2).
vec3 environmentHighlight(SurfacePoint s) {
  float cosine = clamp(dot(s.specularNormal, s.toEye), 0.0, 1.0);
  float m2 = s.roughness * s.roughness;
  vec3 light = environmentLight(reflect(-s.toEye, s.specularNormal),
    vec3(1.0, exp(-m2), exp(-4.0 * m2)));
  vec2 size = vec2(textureSize(l_environment_brdf, 0));
  float row = (s.roughness - LEAST_TABLE_M) / (MOST_TABLE_M - LEAST_TABLE_M);
  vec2 place = (clamp(vec2(cosine, row), 0.0, 1.0) * (size - 1.0) + 0.5) / size;
  vec2 albedo = table_environment_brdf(place).rg;
  return light * (p_f0 * albedo.x + albedo.y);
}
//@chunk surface_fragment
uniform vec3 u_eye;
uniform vec3 u_to_light;
in float v_depth;
layout(location = 0) out vec4 o_irradiance;
layout(location = 1) out vec4 o_albedo;
layout(location = 2) out vec4 o_specular;
void main() {
  SurfacePoint s;
  s.uv = v_uv;
  s.position = v_position;
  s.normal = normalize(v_normal);
  s.tangent = normalize(v_tangent - dot(v_tangent, s.normal) * s.normal);
  s.bitangent = cross(s.normal, s.tangent);
  if (dot(s.bitangent, v_bitangent) < 0.0) s.bitangent = -s.bitangent;
  s.toLight = u_to_light;
  s.toEye = normalize(u_eye - v_position);
  s.slope = staticSlope(s, v_tangent, v_bitangent) + surfaceSlope(v_uv);
  vec3 n = tilted(s, s.slope);
  s.diffuseNormals = mat3(n, n, n);
  s.specularNormal = n;
  s.roughness = p_roughness;
  s.unseen = 0.0;
  s.intensity = p_specular_intensity;
#ifdef HAS_surface_maps
  vec4 maps = sample_surface_maps(v_uv);
  s.roughness *= maps.r;
  s.intensity *= maps.g;
#endif
  adjustSurface(s);
  float lit = litShare(v_position, s.normal);
  vec3 cosines = lit * clamp(s.toLight * s.diffuseNormals, 0.0, 1.0);
  vec3 irradiance = p_light_intensity * cosines + p_ambient * (0.6 + 0.4 * s.normal.y);
  float facing = lit * clamp(dot(s.specularNormal, s.toLight), 0.0, 1.0);
  vec3 specular = PI * p_light_intensity * facing * surfaceSpecular(s);
  for (int i = 0; i < FURTHER; i++) {
    s.toLight = u_further_to[i];
    float intensity = furtherIntensity(i, v_position - u_light_center);
    irradiance += intensity * clamp(s.toLight * s.diffuseNormals, 0.0, 1.0);
    float across = clamp(dot(s.specularNormal, s.toLight), 0.0, 1.0);
    specular += PI * intensity * across * surfaceSpecular(s);
  }
#if SURROUNDED
  for (int c = 0; c < 3; c++) irradiance[c] += environmentIrradiance(s.diffuseNormals[c])[c];
  specular += environmentHighlight(s);
#endif
  o_irradiance = vec4(irradiance, v_depth);
  o_albedo = vec4(skinAlbedo(v_uv), 1.0);
  o_specular = vec4(s.intensity * specular, surfaceWidth(v_uv));
}
//@chunk inspect_fragment
layout(location = 0) out vec4 o_inspect;
layout(location = 1) out vec4 o_normal;
in float v_depth;
void main() {
  vec2 neutral = neutralFractions(v_uv);
  o_inspect = vec4(v_uv, melaninFraction(neutral), blendHemoglobin(v_uv, neutral.g));
  o_normal = vec4(normalize(v_normal), v_depth);
}
