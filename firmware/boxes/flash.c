/* The flash box: two heads fired together, modeling lamps, analyzer, camera line. */
#include "boxes/box.h"

#include <math.h>
#include <string.h>

#define POWER_STEPS 100000000
#define POWER_MIN_NANO 3906250 /* 1/256 of full */
#define POP_WINDOW_US 60000000
#define CHARGER_HEADROOM 1.05
#define LAMP_TAU_S 20.0
#define HEAT_TRIP 0.8
#define HEAT_CLEAR 0.5
#define CROSSED_MDEG 90000

static KEPT struct {
  uint32_t count;
  us_t pops[POPS_PER_MIN]; /* times of the last ones; the oldest is at `oldest` once it is full */
  uint8_t pop_count, oldest;
  us_t volt_at, recycled_at, heat_at, settled_at;
  double volt, heat; /* volt: relative to full at `volt_at` */
  bool hot;
  int32_t reading_mdeg;
} kept;

static STATE struct {
  int32_t power_steps, sync_us;
  uint16_t center_nm, width_nm; /* of the LED; 0: the tube */
  bool crossed, lit, coming;
  us_t lamp_end, answer_at;
  char token[49];
  char report[136];
  bool failed; /* outcome of the pop: `report`, or `failure` */
  bool darkened;
} unit;

void box_build(void) {
  memset(&kept, 0, sizeof kept);
  kept.volt = 1.0;
  kept.volt_at = kept.recycled_at = kept.heat_at = kept.settled_at = core_now();
  kept.heat = INITIAL_HEAT;
  kept.hot = kept.heat >= HEAT_TRIP;
}

static void turn(int32_t reading_mdeg) {
  us_t start = later(core_now(), kept.settled_at);
  kept.settled_at = start + rotation_us(kept.reading_mdeg, reading_mdeg);
  kept.reading_mdeg = reading_mdeg;
  board_turn(reading_mdeg);
}

static void lamps_out(void) {
  if (unit.lit) {
    unit.lit = false;
    board_set_led(0, 0.0);
  }
}

void box_reset(bool power_up) {
  us_t answer_at = power_up ? core_now() : unit.answer_at;
  box_go_dark();
  bool darkened = unit.darkened && !power_up; /* an answer may still be due */
  memset(&unit, 0, sizeof unit);
  unit.darkened = darkened;
  unit.answer_at = answer_at;
  unit.power_steps = POWER_STEPS;
  turn(0);
}

void box_go_dark(void) {
  lamps_out();
  unit.center_nm = 0;
  if (unit.coming) {
    unit.coming = false;
    unit.darkened = true;
  }
}

/* time ------------------------------------------------------------------------------------ */

static us_t lamp_out_at(void) {
  if (!unit.lit) return NEVER;
  double span = (1.0 - kept.heat) / (1.0 - HEAT_TRIP);
  us_t trips = (us_t)ceil(1e6 * LAMP_TAU_S * log(span > 1.0 ? span : 1.0));
  return sooner(unit.lamp_end, kept.heat_at + trips);
}

us_t box_deadline(void) { return sooner(unit.coming ? unit.answer_at : NEVER, lamp_out_at()); }

static void heat_until_now(void) {
  double goal = unit.lit ? 1.0 : 0.0;
  us_t passed = later(0, core_now() - kept.heat_at);
  kept.heat = goal + (kept.heat - goal) * exp(-seconds_of(passed) / LAMP_TAU_S);
  kept.heat_at = later(core_now(), kept.heat_at);
}

static double voltage(void) {
  /* V(t) = V_end - (V_end - V_0) exp(-t / tau), cut at full; the energy is V^2 */
  double gap = CHARGER_HEADROOM - kept.volt;
  double passed = seconds_of(core_now() - kept.volt_at);
  double volt = CHARGER_HEADROOM - gap * exp(-passed / CHARGE_TAU_S);
  return volt < 1.0 ? volt : 1.0;
}

static double power(void) { return (double)unit.power_steps / (double)POWER_STEPS; }

static void put_led(struct text *text) {
  put_flash(text, P("LED-"));
  put_int(text, unit.center_nm);
  put_char(text, '-');
  put_int(text, unit.width_nm);
}

static void put_polarizer(struct text *text) {
  put_flash(text, unit.crossed ? P("CROS") : P("PAR"));
}

static void pop(void) {
  struct text text;
  unit.coming = false;
  lamps_out();
  unit.failed = !board_pop(power(), unit.center_nm, unit.width_nm);
  if (unit.failed) return;
  double volt = voltage(), rest = volt * volt - power();
  kept.volt = sqrt(rest > 0.0 ? rest : 0.0);
  kept.volt_at = core_now();
  kept.recycled_at =
      core_now() + (2 * (int64_t)RECYCLE_US * unit.power_steps + POWER_STEPS) / (2 * POWER_STEPS);
  kept.pops[kept.oldest] = core_now();
  kept.oldest = (uint8_t)((kept.oldest + 1u) % POPS_PER_MIN);
  if (kept.pop_count < POPS_PER_MIN) kept.pop_count++;
  kept.count++;
  text_start(&text, unit.report, sizeof unit.report);
  put_string(&text, unit.token);
  put_char(&text, ',');
  put_int(&text, core_clock_us());
  put_char(&text, ',');
  put_fixed(&text, unit.power_steps, 8);
  put_char(&text, ',');
  put_polarizer(&text);
  put_char(&text, ',');
  put_fixed(&text, kept.reading_mdeg, 3);
  put_char(&text, ',');
  put_int(&text, kept.count);
  if (unit.center_nm) {
    put_char(&text, ',');
    put_led(&text);
  }
  unit.center_nm = 0;
}

void box_advance(void) {
  if (core_stop_opens()) box_go_dark();
  us_t due = box_deadline();
  if (due <= core_now()) {
    bool lamp_ends = lamp_out_at() <= core_now();
    heat_until_now();
    if (unit.coming && unit.answer_at <= core_now()) pop();
    if (lamp_ends) {
      if (kept.heat >= HEAT_TRIP - HEAT_TOLERANCE) kept.hot = true;
      lamps_out();
    }
  }
  heat_until_now();
  if (kept.heat < HEAT_CLEAR) kept.hot = false;
}

bool box_is_busy(void) { return core_now() < kept.settled_at; }

/* Return the time until a pop is possible, and the refusal until then. */
static us_t wait_for_fire(enum code *code, flash_text *why) {
  double need = sqrt(power());
  double gap = (CHARGER_HEADROOM - voltage()) / (CHARGER_HEADROOM - need);
  us_t now = core_now(), wait = unit.answer_at - now, other;
  *code = CODE_IGNORED;
  *why = P("about to pop");
  if ((other = kept.settled_at - now) > wait) wait = other, *why = P("analyzer turning");
  if ((other = kept.recycled_at - now) > wait)
    wait = other, *code = CODE_RECYCLE, *why = P("tube");
  bool full = kept.pop_count == POPS_PER_MIN;
  other = full ? POP_WINDOW_US - (now - kept.pops[kept.oldest]) : 0;
  if (other > wait) wait = other, *code = CODE_DUTY, *why = P("pops per minute");
  other = (us_t)floor(1e6 * CHARGE_TAU_S * log(gap > 1.0 ? gap : 1.0) + 0.5);
  if (other > wait) wait = other, *code = CODE_IGNORED, *why = P("charging");
  return wait;
}

uint16_t box_status(void) {
  enum code code;
  flash_text why;
  bool waits = wait_for_fire(&code, &why) > 0;
  return (uint16_t)(box_is_busy() << 4 | waits << 5 | unit.lit << 6 | kept.hot << 7);
}

us_t box_pending_due(void) { return unit.answer_at; }

enum code box_pending_outcome(struct text *answer) {
  if (unit.darkened) {
    unit.darkened = false;
    return refuse(CODE_HARDWARE, P("made dark before the pop"));
  }
  if (unit.failed) return refuse(CODE_HARDWARE, P("the tube did not ignite"));
  put_string(answer, unit.report);
  return CODE_OK;
}

/* commands -------------------------------------------------------------------------------- */

COMMAND(do_flas_pol) {
  (void)answer;
  bool crossed = equals_word(arguments, P("CROS"));
  if (!crossed && !equals_word(arguments, P("PAR")))
    return refuse(CODE_SYNTAX, P("expected PAR or CROS"));
  unit.crossed = crossed;
  turn(crossed ? CROSSED_MDEG : 0);
  return CODE_OK;
}

COMMAND(get_flas_pol) {
  UNUSED;
  put_polarizer(answer);
  return CODE_OK;
}

COMMAND(do_flas_pol_ang) {
  (void)answer;
  int64_t mdeg;
  TRY(parse_number(arguments, 0, 180 * NANO, P("degrees"), 3, &mdeg));
  turn((int32_t)mdeg);
  return CODE_OK;
}

COMMAND(get_flas_pol_ang) {
  UNUSED;
  put_fixed(answer, kept.reading_mdeg, 3);
  return CODE_OK;
}

COMMAND(do_flas_pow) {
  (void)answer;
  int64_t steps;
  TRY(parse_number(arguments, POWER_MIN_NANO, NANO, P("of full power"), 8, &steps));
  unit.power_steps = (int32_t)steps;
  return CODE_OK;
}

COMMAND(get_flas_pow) {
  UNUSED;
  put_fixed(answer, unit.power_steps, 8);
  return CODE_OK;
}

COMMAND(do_flas_sync) {
  (void)answer;
  int64_t us;
  TRY(parse_number(arguments, 0, 50000 * NANO, P("us"), 0, &us));
  unit.sync_us = (int32_t)us;
  return CODE_OK;
}

COMMAND(get_flas_sync) {
  UNUSED;
  put_int(answer, unit.sync_us);
  return CODE_OK;
}

COMMAND(do_flas_led) {
  (void)answer;
  int64_t center, width;
  char *second = cut(arguments, ',');
  if (!second) return refuse(CODE_SYNTAX, P("expected center,width in nm"));
  TRY(parse_number(arguments, 420 * NANO, 680 * NANO, P("nm"), 0, &center));
  TRY(parse_number(second, 5 * NANO, 50 * NANO, P("nm"), 0, &width));
  unit.center_nm = (uint16_t)center;
  unit.width_nm = (uint16_t)width;
  return CODE_OK;
}

COMMAND(get_flas_led) {
  UNUSED;
  if (unit.center_nm)
    put_led(answer);
  else
    put_flash(answer, P("TUBE"));
  return CODE_OK;
}

COMMAND(get_flas_char) {
  UNUSED;
  enum code code;
  flash_text why;
  us_t wait = ceil_ms(later(0, wait_for_fire(&code, &why)));
  double volt = voltage();
  put_real(answer, volt * volt, 4);
  put_char(answer, ',');
  put_int(answer, wait == 0);
  put_char(answer, ',');
  put_int(answer, wait);
  return CODE_OK;
}

COMMAND(do_flas_fire) {
  TRY(parse_token(arguments));
  TRY(refuse_open_stop());
  enum code code;
  flash_text why;
  us_t wait = wait_for_fire(&code, &why);
  if (wait > 0) {
    refuse(code, why);
    put_flash(reason(), P(", "));
    put_int(reason(), ceil_ms(wait));
    put_flash(reason(), P(" ms"));
    return code;
  }
  lamps_out();
  core_update_clock();
  board_release_cameras(1);
  struct text token;
  text_start(&token, unit.token, sizeof unit.token);
  put_string(&token, arguments);
  unit.darkened = false;
  unit.coming = true;
  unit.answer_at = core_now() + unit.sync_us;
  if (unit.sync_us > 0) return CODE_PENDING;
  pop();
  return box_pending_outcome(answer);
}

COMMAND(get_flas_last) {
  UNUSED;
  if (*unit.report)
    put_string(answer, unit.report);
  else
    put_flash(answer, P("NONE"));
  return CODE_OK;
}

COMMAND(get_flas_coun) {
  UNUSED;
  put_int(answer, kept.count);
  return CODE_OK;
}

COMMAND(do_flas_lamp) {
  (void)answer;
  char *length = cut(arguments, ',');
  bool on = equals_word(arguments, P("ON"));
  if (!on && !equals_word(arguments, P("OFF")))
    return refuse(CODE_SYNTAX, P("expected ON or OFF"));
  if (!on) {
    if (length && *length) return refuse(CODE_SYNTAX, P("expected OFF"));
    lamps_out();
    return CODE_OK;
  }
  int64_t span;
  TRY(parse_number(length ? length : "", NANO, 500 * NANO, P("ms"), 3, &span));
  TRY(refuse_open_stop());
  if (kept.hot) return refuse(CODE_THERMAL, P("wait until below 0.5"));
  if (!unit.lit && !board_set_led(0, 1.0)) {
    board_set_led(0, 0.0);
    return refuse(CODE_HARDWARE, P("the lamp draws no current"));
  }
  unit.lit = true;
  unit.lamp_end = core_now() + span;
  return CODE_OK;
}

COMMAND(get_flas_lamp) {
  UNUSED;
  put_int(answer, unit.lit);
  return CODE_OK;
}

COMMAND(do_cam_trig) {
  TRY(parse_token(arguments));
  core_update_clock();
  board_release_cameras(1);
  put_string(answer, arguments);
  put_char(answer, ',');
  put_int(answer, core_clock_us());
  return CODE_OK;
}
