/* The LEDs and their driver: switching, heat, duty and dose. */
#include <math.h>
#include <string.h>

#include "boxes/led.h"

#define TRIP_RESET_FRACTION 0.5

static KEPT struct {
  double heat[LEDS], dose_ws[LEDS];
  bool hot[LEDS];
  us_t heat_at;
  struct pulse past[HISTORY];
  uint32_t past_count; /* ever; the next one goes to its remainder */
} kept;

static STATE struct {
  double level[LEDS];
  us_t since[LEDS], end[LEDS];
  bool lit[LEDS], failed[LEDS];
  uint16_t order[LEDS], count; /* lit LEDs, as they came on */
} bank;

void bank_build(void) {
  memset(&kept, 0, sizeof kept);
  memset(&bank, 0, sizeof bank);
  for (uint16_t k = 0; k < LEDS; k++) {
    kept.heat[k] = INITIAL_HEAT;
    kept.hot[k] = INITIAL_HEAT >= THERMAL_TRIP;
  }
  kept.heat_at = core_now();
}

bool bank_is_lit(uint16_t led) { return bank.lit[led]; }
bool bank_has_failed(uint16_t led) { return bank.failed[led]; }
void bank_forget_failed(void) { memset(bank.failed, 0, sizeof bank.failed); }
bool bank_any_lit(void) { return bank.count > 0; }
double bank_dose_ws(uint16_t led) { return kept.dose_ws[led]; }
void bank_new_subject(void) { memset(kept.dose_ws, 0, sizeof kept.dose_ws); }

bool bank_has_tripped(void) {
  for (uint16_t k = 0; k < LEDS; k++)
    if (kept.hot[k]) return true;
  return false;
}

/* time ------------------------------------------------------------------------------------ */

us_t bank_deadline(void) {
  us_t due = NEVER;
  for (uint16_t k = 0; k < bank.count; k++) {
    uint16_t led = bank.order[k];
    due = sooner(due, bank.end[led]);
    if (bank.level[led] > THERMAL_TRIP) {
      double ratio = (bank.level[led] - kept.heat[led]) / (bank.level[led] - THERMAL_TRIP);
      us_t trips = (us_t)ceil(1e6 * THERMAL_TAU_S * log(ratio > 1.0 ? ratio : 1.0));
      due = sooner(due, kept.heat_at + trips);
    }
  }
  return due;
}

static void heat_until_now(void) {
  if (core_now() <= kept.heat_at) return;
  /* dT/dt = (level - T) / tau: each temperature relaxes toward its LED's level */
  double fade = exp(-seconds_of(core_now() - kept.heat_at) / THERMAL_TAU_S);
  for (uint16_t k = 0; k < LEDS; k++) {
    double goal = bank.lit[k] ? bank.level[k] : 0.0;
    kept.heat[k] = goal + (kept.heat[k] - goal) * fade;
  }
  kept.heat_at = core_now();
}

bool bank_advance(void) {
  bool cool = true;
  heat_until_now();
  for (uint16_t k = 0; k < bank.count; k++) {
    uint16_t led = bank.order[k];
    if (kept.heat[led] >= THERMAL_TRIP - HEAT_TOLERANCE) {
      kept.hot[led] = true;
      cool = false;
      put_int(event_start(P("LED:HOT")), led);
      event_end();
    }
  }
  for (uint16_t k = 0; k < bank.count;) {
    uint16_t led = bank.order[k];
    if (bank.end[led] <= core_now())
      bank_switch_off(led);
    else
      k++;
  }
  for (uint16_t k = 0; k < LEDS; k++)
    kept.hot[k] = kept.hot[k] && kept.heat[k] >= TRIP_RESET_FRACTION * THERMAL_TRIP;
  return cool;
}

void bank_keep_ends(void) {
  us_t now = board_now_us();
  board_feed_watchdog();
  for (uint16_t k = 0; k < bank.count; k++) {
    uint16_t led = bank.order[k];
    if (bank.end[led] <= now || core_lease_is_over(now)) board_set_led(led, 0.0);
  }
}

/* switching ------------------------------------------------------------------------------- */

bool bank_switch_on(uint16_t led, double level, us_t end) {
  bank_switch_off(led);
  if (bank.failed[led]) return true;
  if (!board_set_led(led, level)) {
    board_set_led(led, 0.0); /* its contact may close again */
    bank.failed[led] = true;
    put_int(event_start(P("LED:FAIL")), led);
    event_end();
    return false;
  }
  if (level > 0.0) {
    heat_until_now();
    bank.lit[led] = true;
    bank.level[led] = level;
    bank.since[led] = core_now();
    bank.end[led] = end;
    bank.order[bank.count++] = led;
  }
  return true;
}

void bank_switch_off(uint16_t led) {
  if (!bank.lit[led]) return;
  heat_until_now();
  board_set_led(led, 0.0);
  bank.lit[led] = false;
  uint16_t place = 0;
  while (bank.order[place] != led) place++;
  bank.count--;
  for (; place < bank.count; place++) bank.order[place] = bank.order[place + 1];
  us_t span = core_now() - bank.since[led];
  if (span <= 0) return;
  double level = bank.level[led];
  kept.dose_ws[led] += LED_POWER_W[led] * level * seconds_of(span);
  struct pulse *pulse = &kept.past[kept.past_count++ % HISTORY];
  *pulse = (struct pulse){level, bank.since[led], core_now(), led};
}

void bank_all_off(void) {
  while (bank.count) bank_switch_off(bank.order[0]);
}

/* what is asked for ----------------------------------------------------------------------- */

static uint32_t past_first(void) {
  return kept.past_count > HISTORY ? kept.past_count - HISTORY : 0;
}

void bank_visit_since(us_t start, visit_pulse *visit, void *context) {
  for (uint32_t k = past_first(); k < kept.past_count; k++)
    if (kept.past[k % HISTORY].off > start) visit(&kept.past[k % HISTORY], context);
  for (uint16_t k = 0; k < bank.count; k++) {
    uint16_t led = bank.order[k];
    struct pulse pulse = {bank.level[led], bank.since[led], bank.end[led], led};
    if (pulse.off != NEVER) visit(&pulse, context);
  }
}

/* The pulses of one LED: those before, and the requested ones from `first_new` on. */
static struct {
  uint16_t count, first_new;
  bool full;
  us_t on[LED_PULSES], off[LED_PULSES];
  double level[LED_PULSES];
  /* switching times, and the light given until each */
  us_t times[2 * LED_PULSES];
  double given[2 * LED_PULSES];
} judged;

static void collect(const struct pulse *pulse, void *context) {
  (void)context;
  if (judged.count == LED_PULSES) {
    judged.full = true;
    return;
  }
  judged.on[judged.count] = pulse->on;
  judged.off[judged.count] = pulse->off;
  judged.level[judged.count++] = pulse->level;
}

static void collect_led(uint16_t led, requested_light *light) {
  us_t now = core_now();
  judged.count = 0;
  judged.full = kept.past_count > HISTORY &&
                kept.past[kept.past_count % HISTORY].off > now - DUTY_WINDOW_US;
  for (uint32_t k = past_first(); k < kept.past_count; k++) {
    const struct pulse *pulse = &kept.past[k % HISTORY];
    if (pulse->led == led && pulse->off > now - DUTY_WINDOW_US) collect(pulse, NULL);
  }
  if (bank.lit[led] && bank.since[led] < now) {
    /* the request replaces light in progress, but its energy so far counts */
    struct pulse pulse = {bank.level[led], bank.since[led], now, led};
    collect(&pulse, NULL);
  }
  judged.first_new = judged.count;
  light(led, collect, NULL);
}

/* Sort switching times, and integrate the light up to each. */
static void integrate(void) {
  uint16_t count = 0;
  for (uint16_t k = 0; k < 2 * judged.count; k++) {
    bool on = k < judged.count;
    uint16_t pulse = (uint16_t)(on ? k : k - judged.count);
    us_t at = on ? judged.on[pulse] : judged.off[pulse];
    double rate = on ? judged.level[pulse] : -judged.level[pulse];
    uint16_t place = count++;
    for (; place && judged.times[place - 1] > at; place--) {
      judged.times[place] = judged.times[place - 1];
      judged.given[place] = judged.given[place - 1];
    }
    judged.times[place] = at;
    judged.given[place] = rate;
  }
  double rate = 0.0, given = 0.0;
  for (uint16_t k = 0; k < count; k++) {
    if (k) given += rate * seconds_of(judged.times[k] - judged.times[k - 1]);
    rate += judged.given[k];
    judged.given[k] = given;
  }
}

static double given_until(us_t at) {
  uint16_t low = 0, high = (uint16_t)(2 * judged.count - 1);
  if (at <= judged.times[0]) return judged.given[0];
  if (at >= judged.times[high]) return judged.given[high];
  while (high - low > 1) {
    uint16_t middle = (uint16_t)((low + high) / 2);
    if (judged.times[middle] <= at)
      low = middle;
    else
      high = middle;
  }
  double slope = (judged.given[high] - judged.given[low]) /
                 (double)(judged.times[high] - judged.times[low]);
  return slope * (double)(at - judged.times[low]) + judged.given[low];
}

/* The largest mean level over all windows that end in the new light. */
static double largest_duty(void) {
  us_t first = judged.on[judged.first_new], last = judged.off[judged.first_new];
  double most = -1.0;
  for (uint16_t k = judged.first_new; k < judged.count; k++) {
    first = sooner(first, judged.on[k]);
    last = later(last, judged.off[k]);
  }
  integrate();
  /* the mean is largest where light ends, or where a window's far edge leaves darkness */
  for (uint16_t k = 0; k < 2 * judged.count; k++) {
    uint16_t pulse = k / 2;
    bool is_new = pulse >= judged.first_new;
    us_t end = k % 2 ? judged.off[pulse] + (is_new ? 0 : DUTY_WINDOW_US)
                     : judged.on[pulse] + DUTY_WINDOW_US;
    if (end <= first || end > last) continue;
    double mean = given_until(end) - given_until(end - DUTY_WINDOW_US);
    if (mean > most) most = mean;
  }
  return most / seconds_of(DUTY_WINDOW_US);
}

static double highest_heat(uint16_t led) {
  double heat = kept.heat[led], most = 0.0;
  us_t at = core_now();
  for (uint16_t k = judged.first_new; k < judged.count; k++) {
    heat *= exp(-seconds_of(later(0, judged.on[k] - at)) / THERMAL_TAU_S);
    double fade = exp(-seconds_of(judged.off[k] - judged.on[k]) / THERMAL_TAU_S);
    heat = judged.level[k] + (heat - judged.level[k]) * fade;
    at = judged.off[k];
    if (heat > most) most = heat;
  }
  return most;
}

static struct {
  bool met[LEDS];
  uint16_t order[LEDS], count;
} requested;

static void note_led(const struct pulse *pulse, void *context) {
  (void)context;
  if (!requested.met[pulse->led]) requested.order[requested.count++] = pulse->led;
  requested.met[pulse->led] = true;
}

static struct text *start_refusal(enum code code, uint16_t led) {
  refuse(code, P("LED "));
  put_int(reason(), led);
  return reason();
}

static enum code judge_led(uint16_t led, struct loads *most) {
  struct text *why;
  if (kept.hot[led]) {
    put_flash(start_refusal(CODE_THERMAL, led), P(", wait until it has cooled"));
    return CODE_THERMAL;
  }
  double duty = largest_duty();
  if (duty > MAX_DUTY + 1e-9) {
    why = start_refusal(CODE_DUTY, led);
    put_flash(why, P(", "));
    put_real(why, duty, 3);
    put_flash(why, P(" over "));
    put_general(why, DUTY_WINDOW_US, 6);
    put_flash(why, P(" s"));
    return CODE_DUTY;
  }
  double heat = highest_heat(led);
  if (heat >= THERMAL_TRIP) {
    why = start_refusal(CODE_THERMAL, led);
    put_flash(why, P(" would reach "));
    put_real(why, heat, 2);
    return CODE_THERMAL;
  }
  double give = 0.0;
  for (uint16_t k = judged.first_new; k < judged.count; k++)
    give += judged.level[k] * seconds_of(judged.off[k] - judged.on[k]);
  double dose = kept.dose_ws[led] + LED_POWER_W[led] * give;
  if (dose > DOSE_WS) {
    why = start_refusal(CODE_LIGHT_DOSE, led);
    put_flash(why, P(", "));
    put_real(why, dose, 2);
    put_flash(why, P(" of "));
    put_general(why, DOSE_NANO_WS, 9);
    put_flash(why, P(" Ws"));
    return CODE_LIGHT_DOSE;
  }
  if (duty > most->duty) most->duty = duty;
  if (heat > most->heat) most->heat = heat;
  if (dose > most->dose_ws) most->dose_ws = dose;
  return CODE_OK;
}

enum code bank_require_within_limits(requested_light *light, struct loads *most) {
  *most = (struct loads){0.0, 0.0, 0.0};
  memset(&requested, 0, sizeof requested);
  heat_until_now();
  light(-1, note_led, NULL);
  for (uint16_t k = 0; k < requested.count; k++) {
    bank_keep_ends();
    collect_led(requested.order[k], light);
    if (judged.full) return refuse(CODE_IGNORED, P("too many pulses in a second"));
    TRY(judge_led(requested.order[k], most));
  }
  return CODE_OK;
}
