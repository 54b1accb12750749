//@chunk fitted_brdf
// A mixture of tabulated lobes, 1/sr, Fresnel's reflection inside: model.brdf_tables and
// model.skin_reflectance (Weyrich et al. 2006, section 7). The atlas holds, for each group of four
// lobes and each slab of phi_d, rows of theta_d and columns of the square root of theta_h.
#ifdef HAS_lobe_atlas
#if defined(HAS_lobe_shares_3)
#define LOBE_GROUPS 4
#elif defined(HAS_lobe_shares_2)
#define LOBE_GROUPS 3
#elif defined(HAS_lobe_shares_1)
#define LOBE_GROUPS 2
#else
#define LOBE_GROUPS 1
#endif
const float LOBE_HALF_PI = 1.57079632679;
const float LOBE_D = 32.0;
const float LOBE_PHI = 12.0;
const float LOBE_H = 90.0;

// Places along theta_d, phi_d (whole) and theta_h, in nodes. Angles come from sines as well as
// cosines: a cosine alone loses theta_h where a highlight peaks.
vec3 lobePlace(vec3 n, vec3 l, vec3 v) {
  vec3 sum = l + v;
  vec3 apart = v - l;
  float cosD = 0.5 * length(sum);
  float sinD = 0.5 * length(apart);
  vec3 h = sum / max(2.0 * cosD, 1e-9);
  float cosH = clamp(dot(n, h), 0.0, 1.0);
  float sinH = length(cross(n, h));
  float cosPhi = min(abs(dot(n, apart)) / max(2.0 * sinD * sinH, 1e-9), 1.0);
  return vec3(
    atan(sinD, cosD) / LOBE_HALF_PI * (LOBE_D - 1.0),
    floor(acos(cosPhi) / LOBE_HALF_PI * (LOBE_PHI - 1.0) + 0.5),
    sqrt(atan(sinH, cosH) / LOBE_HALF_PI) * (LOBE_H - 1.0)
  );
}

vec4 lobeShares(vec2 uv, int group) {
#if LOBE_GROUPS > 1
  if (group == 1) return buffer_lobe_shares_1(uv);
#endif
#if LOBE_GROUPS > 2
  if (group == 2) return buffer_lobe_shares_2(uv);
#endif
#if LOBE_GROUPS > 3
  if (group == 3) return buffer_lobe_shares_3(uv);
#endif
  return buffer_lobe_shares_0(uv);
}

float fittedBrdf(vec2 uv, vec3 n, vec3 l, vec3 v) {
  if (dot(n, l) <= 0.0 || dot(n, v) <= 0.0) return 0.0;
  vec3 place = lobePlace(n, l, v);
  float rows = float(textureSize(t_lobe_atlas, 0).y);
  float slabs = rows / (LOBE_D * float(LOBE_GROUPS));
  float slab = floor((place.y + 0.5) / LOBE_PHI * slabs);
  float total = 0.0;
  for (int group = 0; group < LOBE_GROUPS; group++) {
    float row = (float(group) * slabs + slab) * LOBE_D + min(place.x, LOBE_D - 1.0) + 0.5;
    vec4 lobes = sample_lobe_atlas(vec2((place.z + 0.5) / LOBE_H, row / rows));
    total += dot(lobes, lobeShares(uv, group));
  }
  return total;
}

vec3 fittedSpecular(SurfacePoint s) {
  return vec3(fittedBrdf(s.uv, s.specularNormal, s.toLight, s.toEye));
}

// Share of light that passes the surface, for R_d F_t F_t / pi (model.fresnel, unpolarized).
float fresnelTransmitted(float cosine, float eta) {
  float c = clamp(cosine, 0.0, 1.0);
  float inside = sqrt(1.0 - (1.0 - c * c) / (eta * eta));
  float s = (c - eta * inside) / (c + eta * inside);
  float p = (eta * c - inside) / (eta * c + inside);
  return cosine > 0.0 ? 1.0 - 0.5 * (s * s + p * p) : 0.0;
}
#endif

//@chunk translucency_width
// How much wider than the profile light spreads: 1/sigma_tr over that of the profile.
float translucencyWidth(vec2 uv) {
  return p_measured_translucency > 0.5 ? sample_translucency(uv).r : 1.0;
}

//@chunk lobe_share_pass
// Shares of the lobes under the surface traits: the nearest of at least 0 to what is asked, by
// sweeps of coordinate descent on lobes of length 1 (skinrig.viewer.trait_assets.projected).
uniform float u_gram[SHARE_COUNT * SHARE_COUNT];
uniform float u_scale[SHARE_COUNT];
uniform float u_pull[SHARE_COUNT];
uniform float u_active;
in vec2 v_uv;
layout(location = 0) out vec4 o_0;
#if SHARE_COUNT > 4
layout(location = 1) out vec4 o_1;
#endif
#if SHARE_COUNT > 8
layout(location = 2) out vec4 o_2;
#endif
#if SHARE_COUNT > 12
layout(location = 3) out vec4 o_3;
#endif
void main() {
  float found[SHARE_COUNT];
  float wanted[SHARE_COUNT];
  for (int g = 0; g < SHARE_COUNT / 4; g++) {
    vec4 some = sample_lobe_shares(vec3(v_uv, float(g)));
    for (int c = 0; c < 4; c++) found[4 * g + c] = some[c] * u_scale[4 * g + c];
  }
  if (u_active > 0.5) {
    for (int k = 0; k < SHARE_COUNT; k++) {
      wanted[k] = u_pull[k];
      for (int j = 0; j < SHARE_COUNT; j++) wanted[k] += u_gram[SHARE_COUNT * k + j] * found[j];
    }
    for (int sweep = 0; sweep < SWEEPS; sweep++) {
      for (int k = 0; k < SHARE_COUNT; k++) {
        float now = 0.0;
        for (int j = 0; j < SHARE_COUNT; j++) now += u_gram[SHARE_COUNT * k + j] * found[j];
        found[k] = max(found[k] + wanted[k] - now, 0.0);
      }
    }
  }
  for (int k = 0; k < SHARE_COUNT; k++) found[k] /= u_scale[k];
  o_0 = vec4(found[0], found[1], found[2], found[3]);
#if SHARE_COUNT > 4
  o_1 = vec4(found[4], found[5], found[6], found[7]);
#endif
#if SHARE_COUNT > 8
  o_2 = vec4(found[8], found[9], found[10], found[11]);
#endif
#if SHARE_COUNT > 12
  o_3 = vec4(found[12], found[13], found[14], found[15]);
#endif
}
//@chunk albedo_trait_pass
// Factor by which traits change the albedo: each trait's logarithm at amount 1 or -1, a layer each,
// times the amount (skinrig.editing_albedo gives the ends).
uniform float u_amounts[TRAIT_LAYERS];
in vec2 v_uv;
layout(location = 0) out vec4 o_factor;
void main() {
  vec3 sum = vec3(0.0);
  for (int i = 0; i < TRAIT_LAYERS; i++) {
    if (u_amounts[i] != 0.0) {
      sum += u_amounts[i] * sample_albedo_traits(vec3(v_uv, float(i))).rgb;
    }
  }
  o_factor = vec4(exp(sum), 1.0);
}
