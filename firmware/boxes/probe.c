/* The contact probe: source LED, shutter, fiber cover, suction pump, thermometer. */
#include "boxes/box.h"

#include <math.h>
#include <string.h>

#define LEVEL_STEPS 1000
#define OPENING_MIN_US 1000 /* and the time in which the blades clear the fiber */
#define JAM_DETECTION_US 20000
#define COVER_MOVE_US 300000
#define PUMP_PERIOD_US 50000
#define PUMPING_MAX_US 2000000
#define HELD_SHARE 0.7
#define LOST_SHARE 0.4
#define SUCTION_RATIO_MAX 1.1
#define ALL_FIBERS (-1)

static KEPT struct {
  uint32_t openings, suctions;
  double dose_ws;
  us_t rested_at;
  int16_t fiber;
  us_t settled_at;
  bool jammed;
} kept;

enum shutter { CLOSED, OPENING, OPEN, JAMMING };
enum outcome { MADE_DARK, OPENED, STUCK };

static STATE struct {
  /* source */
  enum shutter shutter;
  enum outcome outcome;
  uint32_t number; /* of the opening that `outcome` is of */
  us_t clears_at, ends_at, jams_at, answer_at, lit_since, opened_us, closed_us;
  bool lit;
  uint16_t level;
  uint32_t last_number; /* 0: none */
  flash_text last_end, shut_by;
  /* suction */
  bool pumping, held, placed;
  us_t pump_start, pump_end;
  uint32_t ticks;
  int32_t wanted_ubar;
  double mbar;
  char site[49];
  int32_t angle_mdeg;
  char pump_report[64];
} unit;

void box_build(void) {
  memset(&kept, 0, sizeof kept);
  kept.fiber = ALL_FIBERS;
  kept.rested_at = kept.settled_at = core_now();
}

static void put_number(struct text *text, int64_t value) {
  put_char(text, ',');
  put_int(text, value);
}

/* source ---------------------------------------------------------------------------------- */

static double source_w(void) { return SOURCE_W * unit.level / LEVEL_STEPS; }

static void end_light(void) {
  if (!unit.lit) return;
  unit.lit = false;
  kept.dose_ws += source_w() * seconds_of(core_now() - unit.lit_since);
}

static void put_out(void) {
  end_light();
  if (unit.level) board_set_led(0, 0.0);
  unit.level = 0;
}

static void put_shutter_report(struct text *text) {
  put_int(text, unit.last_number);
  put_char(text, ',');
  put_flash(text, unit.last_end);
  put_number(text, unit.opened_us);
  if (unit.closed_us < 0)
    put_flash(text, P(",-"));
  else
    put_number(text, unit.closed_us);
}

static void end_opening(flash_text how) {
  end_light();
  unit.shutter = CLOSED;
  unit.last_end = how;
  unit.closed_us = core_clock_us();
  put_shutter_report(event_start(P("SHUT:END")));
  event_end();
}

static void clear_blades(void) {
  if (!board_shutter_is(true)) {
    unit.outcome = STUCK;
    unit.shutter = CLOSED;
    board_move_shutter(false);
    return;
  }
  unit.shutter = OPEN;
  unit.outcome = OPENED;
  unit.lit = unit.level > 0;
  unit.lit_since = core_now();
  unit.last_number = unit.number;
  unit.last_end = P("OPEN");
  unit.opened_us = core_clock_us();
  unit.closed_us = -1;
  board_release_cameras(1);
}

static bool close_blades(void) {
  board_move_shutter(false);
  return board_shutter_is(false);
}

/* Close at a time that the box or the host chose. */
static void shut(flash_text how) {
  if (close_blades()) {
    end_opening(how);
  } else {
    unit.shutter = JAMMING;
    unit.jams_at = core_now() + JAM_DETECTION_US;
    unit.shut_by = how;
  }
}

/* Switch off the LED: the blades do not close. */
static void give_up(void) {
  put_out();
  kept.jammed = true;
  end_opening(P("JAM"));
}

static void abort_opening(flash_text how) {
  bool was_open = unit.shutter == OPEN || unit.shutter == JAMMING;
  bool jamming = unit.shutter == JAMMING;
  if (unit.shutter == OPENING) {
    board_move_shutter(false);
    unit.shutter = CLOSED;
  } else if (was_open) {
    if (jamming || !close_blades())
      give_up();
    else
      end_opening(how);
  }
}

static us_t shutter_deadline(void) {
  switch (unit.shutter) {
    case OPENING: return unit.clears_at;
    case OPEN: return unit.ends_at;
    case JAMMING: return unit.jams_at;
    default: return NEVER;
  }
}

static void advance_shutter(void) {
  if (unit.shutter == JAMMING && board_shutter_is(false)) end_opening(unit.shut_by);
  if (shutter_deadline() > core_now()) return;
  if (unit.shutter == OPENING)
    clear_blades();
  else if (unit.shutter == JAMMING)
    give_up();
  else
    shut(P("TIMED"));
}

static enum code require_closed(void) {
  if (unit.shutter != CLOSED) return refuse(CODE_IGNORED, P("the shutter is open"));
  if (core_now() < kept.settled_at) return refuse(CODE_IGNORED, P("the cover moves"));
  return CODE_OK;
}

static void move_cover(int16_t fiber) {
  if (fiber == kept.fiber) return;
  kept.fiber = fiber;
  kept.settled_at = core_now() + COVER_MOVE_US;
  board_turn(fiber);
}

/* suction --------------------------------------------------------------------------------- */

static us_t pump_deadline(void) {
  if (!unit.pumping) return NEVER;
  return sooner(unit.pump_start + (us_t)(unit.ticks + 1u) * PUMP_PERIOD_US, unit.pump_end);
}

static void end_suction(flash_text how) {
  struct text text;
  if (!unit.pumping) return;
  unit.pumping = unit.held = false;
  board_set_suction(0.0);
  kept.rested_at = core_now() + REST_US;
  text_start(&text, unit.pump_report, sizeof unit.pump_report);
  put_int(&text, kept.suctions);
  put_char(&text, ',');
  put_flash(&text, how);
  put_char(&text, ',');
  put_real(&text, unit.mbar, 1);
  put_number(&text, core_clock_us());
  put_string(event_start(P("PUMP:END")), unit.pump_report);
  event_end();
  abort_opening(P("PUMP"));
}

static void remove_head(void) { unit.placed = false; }

static void fail_suction(flash_text how) {
  end_suction(how);
  remove_head();
}

static void advance_pump(void) {
  if (pump_deadline() > core_now()) return;
  unit.ticks++;
  double reading, wanted = (double)unit.wanted_ubar / 1e3;
  if (!board_gauge_mbar(&reading)) {
    fail_suction(P("GAUGE"));
    return;
  }
  unit.mbar = reading;
  unit.held = unit.held || reading >= HELD_SHARE * wanted;
  if (reading > SUCTION_RATIO_MAX * (SUCTION_MAX_UBAR / 1e3))
    fail_suction(P("HIGH"));
  else if (unit.held && reading < LOST_SHARE * wanted)
    fail_suction(P("LOST"));
  else if (!unit.held && core_now() - unit.pump_start >= PUMPING_MAX_US)
    fail_suction(P("LOW"));
  else if (core_now() >= unit.pump_end)
    end_suction(P("TIMED"));
}

static us_t rest_ms(void) {
  return unit.pumping ? 0 : ceil_ms(later(0, kept.rested_at - core_now()));
}

static enum code read_gauge(double *mbar) {
  return board_gauge_mbar(mbar) ? CODE_OK : refuse(CODE_HARDWARE, P("the pressure gauge is dead"));
}

/* the box --------------------------------------------------------------------------------- */

static void release_head(flash_text how) {
  put_out();
  abort_opening(how);
  end_suction(how);
  remove_head();
}

void box_go_dark(void) { release_head(P("DARK")); }

void box_reset(bool power_up) {
  box_go_dark();
  if (power_up) {
    memset(&unit, 0, sizeof unit);
    unit.answer_at = core_now();
  }
  move_cover(ALL_FIBERS);
}

us_t box_deadline(void) { return sooner(shutter_deadline(), pump_deadline()); }

void box_advance(void) {
  if (core_stop_opens()) release_head(P("INTERLOCK"));
  do {
    advance_shutter();
    advance_pump();
  } while (box_deadline() <= core_now());
}

bool box_is_busy(void) { return unit.shutter != CLOSED || core_now() < kept.settled_at; }

uint16_t box_status(void) {
  return (uint16_t)(box_is_busy() << 4 | unit.pumping << 5 | unit.lit << 6 | unit.placed << 9 |
                    (rest_ms() > 0) << 10 | kept.jammed << 11);
}

us_t box_pending_due(void) { return unit.answer_at; }

enum code box_pending_outcome(struct text *answer) {
  if (unit.outcome == STUCK) return refuse(CODE_HARDWARE, P("the shutter did not open"));
  if (unit.outcome == MADE_DARK) return refuse(CODE_HARDWARE, P("made dark before it opened"));
  put_int(answer, unit.number);
  put_number(answer, unit.opened_us);
  return CODE_OK;
}

/* commands: head and pump ----------------------------------------------------------------- */

COMMAND(do_head_site) {
  (void)answer;
  int64_t mdeg;
  char *angle = cut(arguments, ',');
  TRY(parse_token(arguments));
  TRY(parse_number(angle ? angle : "", 0, 360 * NANO, P("degrees, less than 360"), 3, &mdeg));
  if (mdeg == 360000) return refuse(CODE_OUT_OF_RANGE, P("expected 0 to less than 360 degrees"));
  TRY(require_closed());
  if (unit.pumping) return refuse(CODE_IGNORED, P("the pump is on; PUMP VENT first"));
  struct text site;
  text_start(&site, unit.site, sizeof unit.site);
  put_string(&site, arguments);
  unit.angle_mdeg = (int32_t)mdeg;
  unit.placed = true;
  return CODE_OK;
}

COMMAND(get_head_site) {
  UNUSED;
  if (!unit.placed) {
    put_flash(answer, P("NONE"));
    return CODE_OK;
  }
  put_string(answer, unit.site);
  put_char(answer, ',');
  put_general(answer, unit.angle_mdeg, 3);
  return CODE_OK;
}

COMMAND(do_head_free) {
  UNUSED;
  abort_opening(P("ASKED"));
  end_suction(P("ASKED"));
  remove_head();
  return CODE_OK;
}

COMMAND(do_pump) {
  int64_t span, ubar;
  double mbar;
  if (equals_word(arguments, P("VENT"))) {
    end_suction(P("ASKED"));
    return CODE_OK;
  }
  char *length = cut(arguments, ',');
  char *suction = length ? cut(length, ',') : NULL;
  if (!equals_word(arguments, P("ON")) || !suction)
    return refuse(CODE_SYNTAX, P("expected ON,<ms>,<mbar> or VENT"));
  TRY(parse_number(length, 100 * NANO, SUCTION_MAX_US * (NANO / 1000), P("ms"), 3, &span));
  TRY(parse_number(suction, 10 * NANO, SUCTION_MAX_UBAR * (NANO / 1000), P("mbar"), 3, &ubar));
  TRY(refuse_open_stop());
  if (unit.pumping) return refuse(CODE_IGNORED, P("the pump is on; PUMP VENT first"));
  if (!unit.placed) return refuse(CODE_IGNORED, P("HEAD:SITE first"));
  if (rest_ms()) {
    refuse(CODE_RECYCLE, P("skin, "));
    put_int(reason(), rest_ms());
    put_flash(reason(), P(" ms"));
    return CODE_RECYCLE;
  }
  TRY(read_gauge(&mbar));
  unit.pumping = true;
  unit.pump_start = core_now();
  unit.pump_end = core_now() + span;
  unit.ticks = 0;
  unit.held = false;
  unit.mbar = 0.0;
  unit.wanted_ubar = (int32_t)ubar;
  board_set_suction((double)ubar / 1e3);
  put_int(answer, ++kept.suctions);
  return CODE_OK;
}

COMMAND(get_pump) {
  UNUSED;
  if (unit.pumping) {
    put_flash(answer, P("ON,"));
    put_general(answer, unit.wanted_ubar, 3);
    put_number(answer, ceil_ms(unit.pump_end - core_now()));
  } else if (rest_ms()) {
    put_flash(answer, P("REST"));
    put_number(answer, rest_ms());
  } else {
    put_flash(answer, P("VENT"));
  }
  return CODE_OK;
}

COMMAND(get_pump_last) {
  UNUSED;
  if (*unit.pump_report)
    put_string(answer, unit.pump_report);
  else
    put_flash(answer, P("NONE"));
  return CODE_OK;
}

COMMAND(get_pres) {
  (void)arguments;
  double mbar;
  TRY(read_gauge(&mbar));
  put_real(answer, mbar, 1);
  return CODE_OK;
}

/* commands: light ------------------------------------------------------------------------- */

COMMAND(do_led) {
  (void)answer;
  uint32_t level;
  if (!parse_digits(arguments, 4, &level))
    return refuse(CODE_SYNTAX, P("expected a whole number of thousandths"));
  if (level > LEVEL_STEPS) return refuse(CODE_OUT_OF_RANGE, P("expected 0 to 1000 thousandths"));
  if (level == 0) {
    put_out();
    return CODE_OK;
  }
  TRY(refuse_open_stop());
  TRY(require_closed());
  if (kept.jammed) return refuse(CODE_HARDWARE, P("the shutter is stuck open; SHUT CLOSE"));
  if (!board_set_led(0, (double)level / LEVEL_STEPS)) {
    board_set_led(0, 0.0);
    return refuse(CODE_HARDWARE, P("the LED draws no current"));
  }
  unit.level = (uint16_t)level;
  return CODE_OK;
}

COMMAND(get_led) {
  UNUSED;
  put_int(answer, unit.level);
  return CODE_OK;
}

static enum code open_shutter(int64_t span) {
  if (kept.jammed) return refuse(CODE_HARDWARE, P("the shutter is stuck open; SHUT CLOSE"));
  TRY(require_closed());
  if (core_now() < unit.answer_at) return refuse(CODE_IGNORED, P("the shutter is open"));
  double dose = kept.dose_ws + source_w() * ((double)span / 1e6);
  if (dose > DOSE_WS) {
    refuse(CODE_LIGHT_DOSE, P(""));
    put_flash(reason(), P("; "));
    put_real(reason(), dose, 3);
    put_flash(reason(), P(" of "));
    put_general(reason(), DOSE_NANO_WS, 9);
    put_flash(reason(), P(" Ws"));
    return CODE_LIGHT_DOSE;
  }
  core_update_clock();
  unit.number = ++kept.openings;
  unit.shutter = OPENING;
  unit.outcome = MADE_DARK;
  unit.answer_at = unit.clears_at = core_now() + OPENING_MIN_US;
  unit.ends_at = unit.clears_at + span;
  board_move_shutter(true);
  return CODE_PENDING;
}

COMMAND(do_shut) {
  (void)answer;
  if (equals_word(arguments, P("CLOSE"))) {
    if (kept.jammed) {
      kept.jammed = !close_blades();
      if (kept.jammed) return refuse(CODE_HARDWARE, P("the shutter is stuck open"));
    } else if (unit.shutter == OPENING) {
      abort_opening(P("ASKED"));
    } else if (unit.shutter == OPEN) {
      shut(P("ASKED"));
    }
    return CODE_OK;
  }
  int64_t span;
  char *length = cut(arguments, ',');
  if (!equals_word(arguments, P("OPEN")))
    return refuse(CODE_SYNTAX, P("expected OPEN,<ms> or CLOSE"));
  TRY(parse_number(length ? length : "", NANO, SHUTTER_MAX_US * (NANO / 1000), P("ms"), 3, &span));
  TRY(refuse_open_stop());
  if (unit.level > 0 && !unit.held)
    return refuse(CODE_IGNORED, P("the head is not held; PUMP ON, and wait"));
  return open_shutter(span);
}

COMMAND(get_shut) {
  UNUSED;
  if (kept.jammed) {
    put_flash(answer, P("JAM"));
  } else if (unit.shutter == OPEN || unit.shutter == JAMMING) {
    bool timed = unit.shutter == OPEN;
    put_flash(answer, P("OPEN"));
    put_number(answer, timed ? ceil_ms(later(0, unit.ends_at - core_now())) : 0);
  } else {
    put_flash(answer, P("CLOSED"));
  }
  return CODE_OK;
}

COMMAND(get_shut_last) {
  UNUSED;
  if (unit.last_number)
    put_shutter_report(answer);
  else
    put_flash(answer, P("NONE"));
  return CODE_OK;
}

COMMAND(get_shut_coun) {
  UNUSED;
  put_int(answer, kept.openings);
  return CODE_OK;
}

COMMAND(do_fib) {
  (void)answer;
  uint32_t fiber;
  if (equals_word(arguments, P("ALL"))) {
    TRY(require_closed());
    move_cover(ALL_FIBERS);
    return CODE_OK;
  }
  if (!parse_digits(arguments, 4, &fiber))
    return refuse(CODE_SYNTAX, P("expected the number of a fiber, or ALL"));
  if (fiber >= FIBERS) {
    refuse(CODE_OUT_OF_RANGE, P("expected 0 to "));
    put_int(reason(), FIBERS - 1);
    put_flash(reason(), P(" or ALL"));
    return CODE_OUT_OF_RANGE;
  }
  TRY(require_closed());
  move_cover((int16_t)fiber);
  return CODE_OK;
}

COMMAND(get_fib) {
  UNUSED;
  if (kept.fiber == ALL_FIBERS)
    put_flash(answer, P("ALL"));
  else
    put_int(answer, kept.fiber);
  return CODE_OK;
}

COMMAND(do_cam_trig) {
  TRY(parse_token(arguments));
  core_update_clock();
  board_release_cameras(1);
  put_string(answer, arguments);
  put_number(answer, core_clock_us());
  return CODE_OK;
}

COMMAND(get_cam_temp) {
  UNUSED;
  put_real(answer, board_camera_c(), 2);
  return CODE_OK;
}

COMMAND(get_dose) {
  UNUSED;
  put_real(answer, kept.dose_ws, 6);
  return CODE_OK;
}

COMMAND(do_dose_new) {
  (void)answer;
  TRY(parse_token(arguments));
  kept.dose_ws = 0.0;
  return CODE_OK;
}
