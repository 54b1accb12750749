/* The face scanner: projectors of stripes, and the cameras around them. */
#include <string.h>

#include "boxes/box.h"

#define MIN_SHOW_NANO_MS NANO
#define CODE_OF_COLUMNS 1000 /* of a pattern, for board_turn */
#define CODE_OF_ROWS 2000
#define CODE_OF_PROJECTOR 10000

enum eyes { EYES_OPEN, EYES_CLOSED, EYES_SHIELDED };
enum axis { FULL, COLUMNS, ROWS };

static KEPT struct {
  uint32_t count;
  double dose_ws;
} kept;

static STATE struct {
  uint8_t projector;
  enum axis axis;
  uint16_t pattern;
  enum eyes eyes;
  bool lit, released, darkened;
  us_t start, answer_at, end;
  uint8_t shown; /* projector of the light, or of the last one */
  char token[49];
  us_t released_us;
  char report[88]; /* of the last release; empty: none */
} unit;

void box_build(void) { memset(&kept, 0, sizeof kept); }

static void end_light(void) {
  unit.lit = false;
  board_set_led(unit.shown, 0.0);
  kept.dose_ws += PROJECTOR_W[unit.shown] * seconds_of(sooner(core_now(), unit.end) - unit.start);
}

void box_go_dark(void) {
  if (!unit.lit) return;
  unit.darkened = !unit.released;
  end_light();
}

static void show_pattern(void) {
  int32_t code = unit.axis == FULL      ? 0
                 : unit.axis == COLUMNS ? CODE_OF_COLUMNS + unit.pattern
                                        : CODE_OF_ROWS + unit.pattern;
  board_turn(CODE_OF_PROJECTOR * (int32_t)unit.projector + code);
}

void box_reset(bool power_up) {
  box_go_dark();
  unit.projector = 0;
  unit.axis = FULL;
  unit.pattern = 0;
  unit.eyes = EYES_OPEN;
  if (power_up) {
    memset(&unit, 0, sizeof unit);
    unit.answer_at = core_now();
  }
  show_pattern();
}

/* time ------------------------------------------------------------------------------------ */

us_t box_deadline(void) {
  if (!unit.lit) return NEVER;
  return unit.released ? unit.end : unit.answer_at;
}

static void put_pattern(struct text *text) {
  if (unit.axis == FULL) {
    put_flash(text, P("FULL"));
    return;
  }
  put_flash(text, unit.axis == COLUMNS ? P("COL,") : P("ROW,"));
  put_int(text, unit.pattern);
}

static void release(void) {
  struct text text;
  core_update_clock();
  board_release_cameras(RELEASED_CAMERAS[unit.shown]);
  unit.released = true;
  unit.released_us = core_clock_us();
  kept.count++;
  text_start(&text, unit.report, sizeof unit.report);
  put_string(&text, unit.token);
  put_char(&text, ',');
  put_int(&text, unit.released_us);
  put_char(&text, ',');
  put_int(&text, unit.shown);
  put_char(&text, ',');
  put_pattern(&text);
}

void box_advance(void) {
  if (core_stop_opens()) box_go_dark();
  while (box_deadline() <= core_now()) {
    if (unit.released)
      end_light();
    else
      release();
  }
}

bool box_is_busy(void) { return unit.lit; }

uint16_t box_status(void) {
  return (uint16_t)(unit.lit << 4 | unit.lit << 6 | (unit.eyes != EYES_OPEN) << 9);
}

us_t box_pending_due(void) { return unit.answer_at; }

enum code box_pending_outcome(struct text *answer) {
  if (unit.darkened) return refuse(CODE_HARDWARE, P("made dark before the release"));
  put_string(answer, unit.token);
  put_char(answer, ',');
  put_int(answer, unit.released_us);
  return CODE_OK;
}

/* commands -------------------------------------------------------------------------------- */

static enum code require_dark(void) {
  bool shown = unit.lit || core_now() < unit.answer_at;
  return shown ? refuse(CODE_IGNORED, P("a pattern is shown")) : CODE_OK;
}

COMMAND(do_proj) {
  (void)answer;
  uint32_t projector;
  TRY(parse_integer(arguments, 0, PROJECTORS - 1, &projector));
  TRY(require_dark());
  unit.projector = (uint8_t)projector;
  show_pattern();
  return CODE_OK;
}

COMMAND(get_proj) {
  UNUSED;
  put_int(answer, unit.projector);
  return CODE_OK;
}

COMMAND(do_pat) {
  (void)answer;
  char *number = cut(arguments, ',');
  enum axis axis = equals_word(arguments, P("COL"))   ? COLUMNS
                   : equals_word(arguments, P("ROW")) ? ROWS
                                                      : FULL;
  uint32_t pattern = 0;
  if (axis == FULL) {
    if (!equals_word(arguments, P("FULL")))
      return refuse(CODE_SYNTAX, P("expected COL or ROW or FULL"));
    if (number) return refuse(CODE_SYNTAX, P("expected FULL"));
  } else {
    uint16_t count = axis == COLUMNS ? COLUMN_PATTERNS[unit.projector]
                                     : ROW_PATTERNS[unit.projector];
    TRY(parse_integer(number ? number : "", 0, count - 1, &pattern));
  }
  TRY(require_dark());
  unit.axis = axis;
  unit.pattern = (uint16_t)pattern;
  show_pattern();
  return CODE_OK;
}

COMMAND(get_pat) {
  UNUSED;
  put_pattern(answer);
  return CODE_OK;
}

static enum code refuse_dose(double dose_ws) {
  refuse(CODE_LIGHT_DOSE, P(""));
  put_flash(reason(), P("; "));
  put_real(reason(), dose_ws, 3);
  put_flash(reason(), P(" of "));
  put_general(reason(), DOSE_NANO_WS, 9);
  put_flash(reason(), P(" Ws"));
  return CODE_LIGHT_DOSE;
}

static enum code refuse_short(void) {
  refuse(CODE_OUT_OF_RANGE, P("expected at least settle_ms "));
  put_general(reason(), SETTLE_US, 3);
  return CODE_OUT_OF_RANGE;
}

COMMAND(do_trig) {
  (void)answer;
  int64_t span;
  char *length = cut(arguments, ',');
  TRY(parse_token(arguments));
  if (!length) return refuse(CODE_SYNTAX, P("expected TOKEN,MS"));
  TRY(parse_number(length, MIN_SHOW_NANO_MS, MAX_SHOW_US * (NANO / 1000), P("ms"), 3, &span));
  TRY(refuse_open_stop());
  TRY(require_dark());
  if (unit.eyes == EYES_OPEN) return refuse(CODE_FLICKER, P(""));
  if (!board_set_led(unit.projector, -1.0)) {
    refuse(CODE_HARDWARE, P("the lamp of projector "));
    put_int(reason(), unit.projector);
    put_flash(reason(), P(" draws no current"));
    return CODE_HARDWARE;
  }
  double dose_ws = kept.dose_ws + PROJECTOR_W[unit.projector] * seconds_of(span);
  if (dose_ws > DOSE_WS) return refuse_dose(dose_ws);
  if (span < SETTLE_US) return refuse_short();
  core_update_clock();
  struct text token;
  text_start(&token, unit.token, sizeof unit.token);
  put_string(&token, arguments);
  unit.shown = unit.projector;
  unit.released = unit.darkened = false;
  unit.start = core_now();
  unit.answer_at = unit.start + SETTLE_US;
  unit.end = unit.start + span;
  unit.lit = true;
  board_set_led(unit.shown, 1.0);
  return CODE_PENDING;
}

COMMAND(get_trig_last) {
  UNUSED;
  if (*unit.report)
    put_string(answer, unit.report);
  else
    put_flash(answer, P("NONE"));
  return CODE_OK;
}

COMMAND(get_trig_coun) {
  UNUSED;
  put_int(answer, kept.count);
  return CODE_OK;
}

COMMAND(do_cam_trig) {
  TRY(require_dark());
  TRY(parse_token(arguments));
  core_update_clock();
  board_release_cameras((1u << CAMERAS) - 1u);
  put_string(answer, arguments);
  put_char(answer, ',');
  put_int(answer, core_clock_us());
  return CODE_OK;
}

COMMAND(do_safe_eyes) {
  (void)answer;
  if (equals_word(arguments, P("OPEN"))) {
    unit.eyes = EYES_OPEN;
    box_go_dark();
  } else if (equals_word(arguments, P("CLOSED"))) {
    unit.eyes = EYES_CLOSED;
  } else if (equals_word(arguments, P("SHIELDED"))) {
    unit.eyes = EYES_SHIELDED;
  } else {
    return refuse(CODE_SYNTAX, P("expected OPEN or CLOSED or SHIELDED"));
  }
  return CODE_OK;
}

COMMAND(get_safe_eyes) {
  UNUSED;
  put_flash(answer, unit.eyes == EYES_OPEN     ? P("OPEN")
                    : unit.eyes == EYES_CLOSED ? P("CLOSED")
                                               : P("SHIELDED"));
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
  TRY(require_dark());
  kept.dose_ws = 0.0;
  unit.eyes = EYES_OPEN; /* the statement was of the previous subject */
  return CODE_OK;
}
