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

// The lobes were fitted to skin with all of its slopes. What further slopes a pixel does not show
// widens them: the mean over normals of that variance, by seven of them (exact for polynomials of
// the slope up to the fifth degree). Slopes that are drawn, or that a stretch flattens, would have
// to sharpen the lobes, which a mean cannot.
vec3 fittedSpecular(SurfacePoint s) {
  float variance = max(s.unseen, 0.0) + p_lobe_slope_rms * p_lobe_slope_rms;
  float own = fittedBrdf(s.uv, s.specularNormal, s.toLight, s.toEye);
  if (variance < 1e-6) return vec3(own);
  vec3 n = s.specularNormal;
  vec3 t = normalize(s.tangent - dot(s.tangent, n) * n);
  vec3 b = cross(n, t);
  float sum = 0.5 * own;
  for (int i = 0; i < 6; i++) {
    float turn = float(i) * 1.04719755120;
    vec2 slope = 2.0 * sqrt(variance) * vec2(cos(turn), sin(turn));
    vec3 tiltedNormal = normalize(n - slope.x * t - slope.y * b);
    sum += fittedBrdf(s.uv, tiltedNormal, s.toLight, s.toEye) / 12.0;
  }
  return vec3(sum);
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
uniform vec4 u_gram[SHARE_COUNT * SHARE_GROUPS];
uniform vec4 u_scale[SHARE_GROUPS];
uniform vec4 u_pull[SHARE_GROUPS];
uniform float u_active;
in vec2 v_uv;
layout(location = 0) out vec4 o_0;
#if SHARE_GROUPS > 1
layout(location = 1) out vec4 o_1;
#endif
#if SHARE_GROUPS > 2
layout(location = 2) out vec4 o_2;
#endif
#if SHARE_GROUPS > 3
layout(location = 3) out vec4 o_3;
#endif
vec4 found[SHARE_GROUPS];
float product(int k) {
  float sum = 0.0;
  for (int g = 0; g < SHARE_GROUPS; g++) sum += dot(u_gram[SHARE_GROUPS * k + g], found[g]);
  return sum;
}
void main() {
  vec4 wanted[SHARE_GROUPS];
  for (int g = 0; g < SHARE_GROUPS; g++) {
    found[g] = sample_lobe_shares(vec3(v_uv, float(g))) * u_scale[g];
  }
  if (u_active > 0.5) {
    for (int g = 0; g < SHARE_GROUPS; g++) {
      int k = 4 * g;
      wanted[g] = u_pull[g] + vec4(product(k), product(k + 1), product(k + 2), product(k + 3));
    }
    for (int sweep = 0; sweep < SWEEPS; sweep++) {
      for (int g = 0; g < SHARE_GROUPS; g++) {
        int k = 4 * g;
        found[g].x = max(found[g].x + wanted[g].x - product(k), 0.0);
        found[g].y = max(found[g].y + wanted[g].y - product(k + 1), 0.0);
        found[g].z = max(found[g].z + wanted[g].z - product(k + 2), 0.0);
        found[g].w = max(found[g].w + wanted[g].w - product(k + 3), 0.0);
      }
    }
  }
  o_0 = found[0] / u_scale[0];
#if SHARE_GROUPS > 1
  o_1 = found[1] / u_scale[1];
#endif
#if SHARE_GROUPS > 2
  o_2 = found[2] / u_scale[2];
#endif
#if SHARE_GROUPS > 3
  o_3 = found[3] / u_scale[3];
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
