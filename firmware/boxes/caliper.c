/* The stretching caliper: two jaws on a motor, a force sensor, a turning ring. */
#include "boxes/box.h"

#include <math.h>
#include <string.h>

#define PERIOD_US 5000
#define STALL_LAG_MM 0.05
#define ROTATION_DEG_PER_S 90.0
#define HOMING_SPEED_FRACTION 0.5
#define MIN_DETACHMENT_FORCE_N 0.05
#define DETACHED_FORCE_FRACTION 0.25
#define RELEASE_TIME_US 250000
#define AT_HOME_MM 1e-6
#define FORCE_LIMIT_MIN_NANO 50000000
#define FORCE_LIMIT_MAX_NANO (10 * NANO)

static KEPT struct {
  uint32_t moves;
  int32_t angle_mdeg;
  double zero_n; /* reading of the sensor when it was tared */
  bool attached;
} kept;

static STATE struct {
  bool homed, moving, homing, back, barred, turning;
  int8_t barred_direction;
  int32_t limit_mn; /* 0: none */
  double barred_mm, last_force_n;
  us_t turned_at;
  int32_t turning_mdeg;
  /* the move in progress */
  us_t start, tripped_at;
  uint32_t ticks;
  double from_mm, to_mm, speed, trip_mm, trip_n;
  char report[80];
} unit;

static double jaws_mm(void) {
  double distance_mm, force_n;
  board_read_jaws(&distance_mm, &force_n);
  return distance_mm;
}

static double force_n(void) {
  double distance_mm, force_n;
  board_read_jaws(&distance_mm, &force_n);
  return force_n - kept.zero_n;
}

void box_build(void) { memset(&kept, 0, sizeof kept), kept.angle_mdeg = ANGLES_MDEG[0]; }

void box_reset(bool power_up) {
  box_go_dark();
  char report[sizeof unit.report];
  memcpy(report, unit.report, sizeof report);
  memset(&unit, 0, sizeof unit);
  if (!power_up) memcpy(unit.report, report, sizeof report);
}

/* moves ----------------------------------------------------------------------------------- */

static int8_t direction(void) { return unit.to_mm > unit.from_mm ? 1 : -1; }

static us_t arrives_at(void) {
  return unit.start + (us_t)floor(1e6 * (fabs(unit.to_mm - unit.from_mm) / unit.speed) + 0.5);
}

static us_t next_tick(void) {
  return sooner(unit.start + (us_t)(unit.ticks + 1u) * PERIOD_US, arrives_at());
}

us_t box_deadline(void) {
  us_t due = unit.moving ? next_tick() : NEVER;
  return unit.turning ? sooner(due, unit.turned_at) : due;
}

static void put_number(struct text *text, double value, uint8_t digits) {
  put_char(text, ',');
  put_real(text, value, digits);
}

static void put_clock(struct text *text) {
  put_char(text, ',');
  put_int(text, core_clock_us());
}

static void end_move(flash_text how, bool by_force) {
  unit.moving = false;
  double distance_mm = jaws_mm(), force = force_n();
  struct text text;
  text_start(&text, unit.report, sizeof unit.report);
  put_int(&text, kept.moves);
  put_char(&text, ',');
  put_flash(&text, how);
  put_char(&text, ',');
  put_int(&text, scaled((distance_mm - APERTURE_MM) / STEP_MM, 0));
  put_number(&text, by_force ? unit.trip_mm : distance_mm, 3);
  put_number(&text, by_force ? unit.trip_n : force, 3);
  put_clock(&text);
  put_string(event_start(P("CAL:END")), unit.report);
  event_end();
}

static void release(flash_text why, bool by_force) {
  if (unit.moving) end_move(by_force ? P("FORCE") : P("STOPPED"), by_force);
  if (unit.turning) board_turn(kept.angle_mdeg);
  unit.turning = false;
  unit.barred = false;
  if (kept.attached) {
    kept.attached = false;
    struct text *event = event_start(P("CAL:FREE"));
    put_flash(event, why);
    put_clock(event);
    event_end();
  }
  unit.last_force_n = 0.0;
  board_hold_skin(false);
}

void box_go_dark(void) { release(P("DARK"), false); }

static void turn_back(double distance_mm, double force) {
  unit.trip_mm = distance_mm;
  unit.trip_n = force;
  unit.tripped_at = core_now();
  unit.barred = true;
  unit.barred_direction = direction();
  unit.barred_mm = distance_mm;
  struct text *event = event_start(P("CAL:FORC:TRIP"));
  put_real(event, distance_mm, 3);
  put_number(event, force, 3);
  put_clock(event);
  event_end();
  unit.to_mm = unit.from_mm;
  unit.from_mm = distance_mm;
  unit.start = core_now();
  unit.ticks = 0;
  unit.back = true;
  board_start_jaws(unit.to_mm, true);
}

static void lose_steps(void) {
  if (unit.homing) {
    end_move(P("NOHOME"), false);
    return;
  }
  unit.homed = false;
  end_move(P("STALL"), false);
}

/* At the place of the home mark: done, or on to the end of the travel if it was not detected. */
static void arrive(bool at_mark) {
  if (unit.homing && !at_mark && fabs(unit.to_mm - APERTURE_MM) < AT_HOME_MM) {
    double end_mm = unit.from_mm > APERTURE_MM ? TRAVEL_LOW_MM : TRAVEL_HIGH_MM;
    unit.to_mm = end_mm + copysign(2.0 * STALL_LAG_MM, end_mm - APERTURE_MM);
    board_start_jaws(unit.to_mm, true);
    return;
  }
  unit.homed = unit.homed || unit.homing;
  end_move(P("REACHED"), false);
}

/* Drive the jaws for one control period and check force and position. */
static void control(void) {
  us_t now = core_now();
  bool arrived = now >= arrives_at();
  double passed = seconds_of(now - unit.start);
  double driven = arrived ? unit.to_mm : unit.from_mm + direction() * unit.speed * passed;
  bool at_mark = board_drive_jaws(driven);
  unit.ticks++;
  double limit = (double)unit.limit_mn / 1e3, force = force_n(), distance = jaws_mm();
  double before = unit.last_force_n;
  unit.last_force_n = force;
  bool lost = fabs(driven - distance) > STALL_LAG_MM;
  bool over = fabs(force) >= limit;
  bool pulled = kept.attached && direction() > 0 && before >= MIN_DETACHMENT_FORCE_N;
  if (pulled && fabs(force) <= DETACHED_FORCE_FRACTION * before) {
    kept.attached = false;
    board_hold_skin(false);
    end_move(P("DETACHED"), false);
  } else if (unit.back) {
    if (over && (lost || now - unit.tripped_at > RELEASE_TIME_US))
      release(P("FORCE"), true);
    else if (lost)
      lose_steps();
    else if (arrived)
      end_move(P("FORCE"), true);
  } else if (over) {
    turn_back(distance, force);
  } else if (lost) {
    lose_steps();
  } else if (arrived) {
    arrive(at_mark);
  }
}

void box_advance(void) {
  if (core_stop_opens()) release(P("INTERLOCK"), false);
  while (box_deadline() <= core_now()) {
    if (unit.turning && unit.turned_at <= core_now()) {
      unit.turning = false;
      kept.angle_mdeg = unit.turning_mdeg;
    }
    if (unit.moving && next_tick() <= core_now()) control();
  }
}

bool box_is_busy(void) { return unit.moving || unit.turning; }

uint16_t box_status(void) {
  return (uint16_t)(box_is_busy() << 4 | unit.homed << 5 | kept.attached << 9 | unit.barred << 10);
}

us_t box_pending_due(void) { return NEVER; }

enum code box_pending_outcome(struct text *answer) {
  (void)answer;
  return CODE_OK;
}

/* commands -------------------------------------------------------------------------------- */

static enum code require_sensor(void) {
  return isnan(force_n()) ? refuse(CODE_HARDWARE, P("the force sensor is dead")) : CODE_OK;
}

static enum code require_fit(void) {
  TRY(refuse_open_stop());
  TRY(require_sensor());
  return box_is_busy() ? refuse(CODE_IGNORED, P("on the move")) : CODE_OK;
}

static enum code require_limit(void) {
  if (unit.limit_mn) return CODE_OK;
  return refuse(CODE_IGNORED, P("CAL:FORC:LIM first; it has no default"));
}

static enum code require_free(void) {
  return kept.attached ? refuse(CODE_IGNORED, P("skin is held; CAL:REL first")) : CODE_OK;
}

static enum code begin(double to_mm, bool homing, struct text *answer) {
  unit.moving = true;
  unit.homing = homing;
  unit.back = false;
  unit.from_mm = jaws_mm();
  unit.to_mm = to_mm;
  unit.speed = SPEED_MM_PER_S * (homing ? HOMING_SPEED_FRACTION : 1.0);
  unit.start = core_now();
  unit.ticks = 0;
  unit.last_force_n = force_n();
  board_start_jaws(to_mm, false);
  put_int(answer, ++kept.moves);
  return CODE_OK;
}

COMMAND(do_cal_home) {
  (void)arguments;
  TRY(require_fit());
  TRY(require_limit());
  TRY(require_free());
  unit.homed = false;
  return begin(APERTURE_MM, true, answer);
}

COMMAND(do_cal_step_abs) {
  bool negative = *arguments == '-';
  uint32_t size;
  if (!parse_digits(arguments + negative, 3, &size))
    return refuse(CODE_SYNTAX, P("expected a whole number of steps"));
  int32_t step = negative ? -(int32_t)size : (int32_t)size;
  if (step < STEP_MIN || step > STEP_MAX) {
    refuse(CODE_OUT_OF_RANGE, P("expected "));
    put_int(reason(), STEP_MIN);
    put_flash(reason(), P(" to "));
    put_int(reason(), STEP_MAX);
    put_flash(reason(), P(" steps"));
    return CODE_OUT_OF_RANGE;
  }
  TRY(require_fit());
  TRY(require_limit());
  if (!unit.homed) return refuse(CODE_IGNORED, P("CAL:HOME first"));
  double to_mm = APERTURE_MM + (double)step * STEP_MM;
  if (unit.barred && unit.barred_direction * (to_mm - unit.barred_mm) >= 0.0) {
    refuse(CODE_FORCE, P("the limit was met at "));
    put_real(reason(), unit.barred_mm, 3);
    put_flash(reason(), P(" mm"));
    return CODE_FORCE;
  }
  return begin(to_mm, false, answer);
}

COMMAND(get_cal_pos) {
  UNUSED;
  if (unit.homed)
    put_real(answer, jaws_mm(), 3);
  else
    put_flash(answer, P("NONE"));
  return CODE_OK;
}

COMMAND(get_cal_last) {
  UNUSED;
  if (*unit.report)
    put_string(answer, unit.report);
  else
    put_flash(answer, P("NONE"));
  return CODE_OK;
}

COMMAND(do_cal_ang) {
  (void)answer;
  int64_t mdeg;
  TRY(parse_number(arguments, 0, 180 * NANO, P("degrees"), 3, &mdeg));
  bool known = false;
  for (uint8_t k = 0; k < ANGLE_COUNT; k++) known |= mdeg == ANGLES_MDEG[k];
  if (!known) {
    refuse(CODE_OUT_OF_RANGE, P("expected one of "));
    for (uint8_t k = 0; k < ANGLE_COUNT; k++) {
      if (k) put_flash(reason(), P(", "));
      put_general(reason(), ANGLES_MDEG[k], 3);
    }
    put_flash(reason(), P(" degrees"));
    return CODE_OUT_OF_RANGE;
  }
  TRY(require_fit());
  TRY(require_free());
  double angle = fabs((double)mdeg / 1e3 - (double)kept.angle_mdeg / 1e3);
  unit.turning = true;
  unit.turning_mdeg = (int32_t)mdeg;
  unit.turned_at = core_now() + round_us(angle / ROTATION_DEG_PER_S);
  board_turn(unit.turning_mdeg);
  box_advance();
  return CODE_OK;
}

COMMAND(get_cal_ang) {
  UNUSED;
  put_general(answer, unit.turning ? unit.turning_mdeg : kept.angle_mdeg, 3);
  return CODE_OK;
}

COMMAND(do_cal_att) {
  UNUSED;
  TRY(require_fit());
  TRY(require_free());
  if (!unit.homed || fabs(jaws_mm() - APERTURE_MM) > AT_HOME_MM)
    return refuse(CODE_IGNORED, P("CAL:HOME, or step 0, first"));
  double distance_mm;
  board_read_jaws(&distance_mm, &kept.zero_n);
  board_hold_skin(true);
  kept.attached = true;
  unit.barred = false;
  return CODE_OK;
}

COMMAND(get_cal_att) {
  UNUSED;
  put_int(answer, kept.attached);
  return CODE_OK;
}

COMMAND(do_cal_rel) {
  UNUSED;
  release(P("ASKED"), false);
  return CODE_OK;
}

COMMAND(get_cal_forc) {
  UNUSED;
  TRY(require_sensor());
  put_real(answer, force_n(), 3);
  return CODE_OK;
}

COMMAND(do_cal_forc_lim) {
  (void)answer;
  int64_t limit_mn;
  TRY(parse_number(arguments, FORCE_LIMIT_MIN_NANO, FORCE_LIMIT_MAX_NANO, P("N"), 3, &limit_mn));
  double force = force_n();
  if (fabs(force) >= (double)limit_mn / 1e3) {
    refuse(CODE_FORCE, P("there are "));
    put_real(reason(), force, 3);
    put_flash(reason(), P(" N now; CAL:REL first"));
    return CODE_FORCE;
  }
  unit.limit_mn = (int32_t)limit_mn;
  unit.barred = false;
  return CODE_OK;
}

COMMAND(get_cal_forc_lim) {
  UNUSED;
  if (unit.limit_mn)
    put_general(answer, unit.limit_mn, 3);
  else
    put_flash(answer, P("NONE"));
  return CODE_OK;
}
