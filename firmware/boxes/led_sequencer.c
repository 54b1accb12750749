/* The table of rows: upload, judgment, run, cameras, eyes and dose. */
#include <math.h>
#include <string.h>

#include "boxes/led.h"

#define FLICKER_HISTORY_US 1000000
#define FLICKER_FUSION_US 15385 /* shortest darkness that an eye perceives */
#define JUDGE_US 1000
#define JUDGE_MAX_US 1900000 /* the host gives up after 2 s */
#define ALL_CAMERAS ((uint32_t)((UINT64_C(1) << CAMERAS) - 1u))

enum eyes { EYES_OPEN, EYES_CLOSED, EYES_SHIELDED };
enum run { IDLE, RUN, DONE, STOP };

STATE struct row table[MAX_ROWS];

static STATE struct {
  uint16_t rows, run_rows;
  int32_t run_row;
  uint32_t mask;
  enum eyes eyes;
  bool armed, judging, darkened;
  bool late; /* the judgment took too long */
  us_t asked_at, judged_at;
  struct loads loads;
  enum run run;
  us_t start;
  struct step next;
  char token[49];
  us_t steps[MAX_ROWS]; /* of the last run, on the box's clock; -1: none */
} unit;

uint16_t sequencer_rows(void) { return unit.rows; }
bool sequencer_is_lit(void) { return bank_any_lit(); }
void disarm_sequence(void) { unit.armed = false; }

static void forget_steps(void) {
  for (uint16_t k = 0; k < MAX_ROWS; k++) unit.steps[k] = -1;
}

void sequencer_reset(bool power_up) {
  (void)power_up;
  box_go_dark();
  bank_forget_failed();
  us_t judged_at = unit.judged_at; /* an answer may still be due */
  bool darkened = unit.darkened;
  memset(&unit, 0, sizeof unit);
  unit.judged_at = judged_at;
  unit.darkened = darkened;
  unit.mask = ALL_CAMERAS;
  forget_steps();
}

/* time ------------------------------------------------------------------------------------ */

us_t box_deadline(void) {
  us_t due = bank_deadline();
  return unit.run == RUN ? sooner(due, unit.start + unit.next.at) : due;
}

static void advance_bank(void) {
  if (!bank_advance()) box_go_dark();
}

static void say(flash_text name, int64_t row) {
  struct text *event = event_start(name);
  put_int(event, row);
  put_char(event, ',');
  put_int(event, core_clock_us());
  event_end();
}

static void take_step(void) {
  struct step step = unit.next;
  kind_next_step(&unit.next);
  if (step.action == PULSE) {
    unit.run_row = step.row;
    core_update_clock(); /* a frame is found by this time: the release's, not the table's */
    unit.steps[step.row] = core_clock_us();
    board_release_cameras(table[step.row].mask & unit.mask);
    say(P("SEQ:STEP"), step.row);
  } else if (step.action == END) {
    bank_all_off();
    unit.run = DONE;
    say(P("SEQ:DONE"), unit.run_rows);
  } else {
    kind_switch(&step);
  }
}

/* Judge for a while: a long table takes many calls, and the box answers between them. */
static void judge(void) {
  us_t until = board_now_us() + JUDGE_US;
  while (unit.judging && board_now_us() < until) unit.judging = guard_continue();
  unit.late = unit.judging && core_now() - unit.asked_at > JUDGE_MAX_US;
  if (unit.late) unit.judging = false;
  unit.judged_at = core_now();
}

void box_advance(void) {
  if (core_stop_opens()) box_go_dark();
  if (unit.judging) judge();
  while (box_deadline() <= core_now()) {
    advance_bank();
    while (unit.run == RUN && unit.start + unit.next.at <= core_now()) take_step();
  }
  advance_bank();
}

void box_go_dark(void) {
  bank_all_off();
  unit.armed = false;
  if (unit.judging) {
    unit.judging = false;
    unit.darkened = true;
    unit.judged_at = core_now();
  }
  if (unit.run == RUN) {
    unit.run = STOP;
    say(P("SEQ:STOP"), unit.run_row);
  }
}

uint16_t sequencer_status(void) {
  bool running = unit.run == RUN, safe = unit.eyes != EYES_OPEN;
  return (uint16_t)(running << 4 | unit.armed << 5 | bank_any_lit() << 6 |
                    bank_has_tripped() << 7 | safe << 9);
}

/* table ----------------------------------------------------------------------------------- */

enum code refuse_running(void) {
  if (unit.judging) return refuse(CODE_IGNORED, P("a table is being judged"));
  return unit.run == RUN ? refuse(CODE_IGNORED, P("a sequence is running")) : CODE_OK;
}

enum code refuse_above(flash_text before, int64_t limit, flash_text after) {
  refuse(CODE_OUT_OF_RANGE, before);
  put_int(reason(), limit);
  put_flash(reason(), after);
  return CODE_OUT_OF_RANGE;
}

enum code parse_row_light(const char *level, const char *dwell, const char *mask, bool is_dark,
                          struct row *row) {
  uint32_t steps = 0;
  parse_digits(level, 4, &steps);
  parse_digits(dwell, 7, &row->dwell_us);
  parse_hex(mask, &row->mask);
  row->level = (uint16_t)steps;
  if (steps > LEVEL_STEPS || is_dark != (steps == 0))
    return refuse(CODE_OUT_OF_RANGE, P("expected level 1 to 1000, 0 when dark"));
  if (row->dwell_us < ROW_MIN_US || row->dwell_us > ROW_MAX_US)
    return refuse_above(P("expected 2000 to "), ROW_MAX_US, P(" us"));
  if (row->mask > ALL_CAMERAS) return refuse_above(P("expected a mask of "), CAMERAS, P(" cameras"));
  return CODE_OK;
}

COMMAND(do_seq_cle) {
  UNUSED;
  TRY(refuse_running());
  unit.rows = 0;
  unit.armed = false;
  return CODE_OK;
}

/* Parse all rows; with a target, store them. The text is left as it was. */
static enum code parse_rows(char *text, struct row *target, uint16_t *count) {
  struct row row;
  enum code code = CODE_OK;
  *count = 0;
  for (char *rest; text && code == CODE_OK; text = rest) {
    char part[440];
    rest = cut(text, ';');
    struct text copy;
    text_start(&copy, part, sizeof part);
    put_string(&copy, text);
    if (rest) rest[-1] = ';';
    code = parse_row(part, target ? &target[*count] : &row);
    ++*count;
  }
  return code;
}

/* The shortest row, for which the light could not settle. */
static bool is_too_short(char *text) {
  for (char *rest; text; text = rest) {
    struct row row;
    char part[440];
    struct text copy;
    rest = cut(text, ';');
    text_start(&copy, part, sizeof part);
    put_string(&copy, text);
    if (rest) rest[-1] = ';';
    if (parse_row(part, &row) == CODE_OK && row.dwell_us < SETTLE_US) return true;
  }
  return false;
}

COMMAND(do_seq_def) {
  (void)answer;
  uint32_t first;
  uint16_t count;
  TRY(refuse_running());
  char *rows = cut(arguments, ',');
  if (!rows) return refuse(CODE_SYNTAX, P("expected FIRST,ROW;..."));
  TRY(parse_integer(arguments, 0, unit.rows, &first));
  TRY(parse_rows(rows, NULL, &count)); /* a table is refused as a whole */
  if (first + count > MAX_ROWS) return refuse_above(P("expected at most "), MAX_ROWS, P(" rows"));
  if (is_too_short(rows)) return refuse_above(P("expected rows longer than "), SETTLE_US, P(" us"));
  parse_rows(rows, &table[first], &count);
  if (first + count > unit.rows) unit.rows = (uint16_t)(first + count);
  unit.armed = false;
  return CODE_OK;
}

COMMAND(get_seq_crc) {
  UNUSED;
  uint16_t crc = 0xFFFFu;
  for (uint16_t k = 0; k < unit.rows; k++) {
    char data[160];
    struct text text;
    text_start(&text, data, sizeof data);
    if (k) put_char(&text, '\n');
    put_row(&text, &table[k]);
    crc = crc16(crc, data, text.used);
  }
  put_int(answer, unit.rows);
  put_char(answer, ',');
  put_hex(answer, crc, 4, true);
  return CODE_OK;
}

/* How far light of before is moved back: a table may begin at any time after SEQ:ARM. */
static us_t past_gap;

static void visit_past(const struct pulse *pulse, void *context) {
  if (pulse->on >= core_now()) return;
  struct pulse moved = {pulse->level, pulse->on - past_gap, pulse->off - past_gap, pulse->led};
  (*(visit_pulse **)context)(&moved, NULL);
}

static void past_light(int32_t only, visit_pulse *visit, void *context) {
  (void)only;
  (void)context;
  bank_visit_since(core_now() - FLICKER_HISTORY_US, visit_past, &visit);
}

static enum code require_no_flicker(void) {
  double flashes = guard_flashes_per_s(), rms = guard_rms();
  if (guard_is_full()) return refuse(CODE_IGNORED, P("too many changes of light"));
  if (unit.eyes != EYES_OPEN) return CODE_OK;
  if (flashes >= MAX_FLASHES_PER_S) {
    refuse(CODE_FLICKER, P(""));
    put_flash(reason(), P("; "));
    put_real(reason(), flashes, 1);
    put_flash(reason(), P(" flashes per s at open eyes"));
    return CODE_FLICKER;
  }
  if (rms > MAX_FLICKER_RMS) {
    refuse(CODE_FLICKER, P("rms "));
    put_real(reason(), rms, 2);
    put_flash(reason(), P(" of 3 to 65 Hz at open eyes"));
    return CODE_FLICKER;
  }
  return CODE_OK;
}

enum code require_flicker_limits(requested_light *light) {
  past_gap = 0;
  guard_start(past_light, light);
  while (guard_continue()) {
  }
  return require_no_flicker();
}

static enum code conclude_judgment(struct text *answer) {
  TRY(require_no_flicker());
  unit.armed = true;
  put_real(answer, guard_flashes_per_s(), 2);
  const double values[] = {guard_rms(), unit.loads.duty, unit.loads.heat, unit.loads.dose_ws};
  for (uint8_t k = 0; k < 4; k++) {
    put_char(answer, ',');
    put_real(answer, values[k], 4);
  }
  return CODE_OK;
}

us_t box_pending_due(void) { return unit.judging ? NEVER : unit.judged_at; }

enum code box_pending_outcome(struct text *answer) {
  if (unit.darkened) return refuse(CODE_HARDWARE, P("made dark before the table was judged"));
  if (unit.late) return refuse(CODE_IGNORED, P("the table takes too long to judge"));
  return conclude_judgment(answer);
}

COMMAND(do_seq_arm) {
  uint32_t rows;
  TRY(refuse_running());
  TRY(parse_integer(arguments, 1, MAX_ROWS, &rows));
  if (rows != unit.rows) return refuse_above(P("the table has "), unit.rows, P(" rows"));
  TRY(refuse_open_stop());
  TRY(kind_require_ready());
  bank_all_off(); /* else light whose end is not known would precede the table */
  TRY(bank_require_within_limits(table_light, &unit.loads));
  past_gap = FLICKER_FUSION_US;
  guard_start(past_light, table_light);
  unit.darkened = unit.late = false;
  unit.judging = true;
  unit.asked_at = core_now();
  judge();
  return unit.judging ? CODE_PENDING : conclude_judgment(answer);
}

COMMAND(do_trig) {
  TRY(parse_token(arguments));
  TRY(refuse_running());
  TRY(refuse_open_stop());
  if (!unit.armed) return refuse(CODE_NOT_ARMED, P("SEQ:ARM checks the table first"));
  unit.armed = false;
  bank_all_off();
  forget_steps();
  struct text token;
  text_start(&token, unit.token, sizeof unit.token);
  put_string(&token, arguments);
  core_update_clock();
  unit.run = RUN;
  unit.run_row = -1;
  unit.run_rows = unit.rows;
  unit.start = core_now();
  kind_first_step(&unit.next);
  box_advance();
  put_string(answer, arguments);
  put_char(answer, ',');
  put_int(answer, core_clock_us());
  return CODE_OK;
}

COMMAND(get_seq_pos) {
  UNUSED;
  if (unit.armed || unit.run == IDLE) {
    put_flash(answer, unit.armed ? P("READY,-1,") : P("IDLE,-1,"));
    put_int(answer, unit.rows);
    put_flash(answer, P(",-"));
    return CODE_OK;
  }
  put_flash(answer, unit.run == RUN ? P("RUN,") : unit.run == DONE ? P("DONE,") : P("STOP,"));
  put_int(answer, unit.run_row);
  put_char(answer, ',');
  put_int(answer, unit.run_rows);
  put_char(answer, ',');
  put_string(answer, unit.token);
  return CODE_OK;
}

COMMAND(get_seq_step) {
  uint32_t row;
  TRY(parse_integer(arguments, 0, MAX_ROWS - 1, &row));
  if (unit.steps[row] < 0)
    put_flash(answer, P("NONE"));
  else
    put_int(answer, unit.steps[row]);
  return CODE_OK;
}

/* cameras, eyes, dose --------------------------------------------------------------------- */

COMMAND(do_cam_mask) {
  (void)answer;
  uint32_t mask;
  if (!parse_hex(arguments, &mask))
    return refuse(CODE_SYNTAX, P("expected a mask in hexadecimal digits"));
  if (mask > ALL_CAMERAS) return refuse_above(P("expected a mask of "), CAMERAS, P(" cameras"));
  TRY(refuse_running());
  unit.mask = mask;
  return CODE_OK;
}

COMMAND(get_cam_mask) {
  UNUSED;
  put_hex(answer, unit.mask, 1, true);
  return CODE_OK;
}

COMMAND(do_cam_trig) {
  TRY(parse_token(arguments));
  TRY(refuse_running());
  core_update_clock();
  board_release_cameras(unit.mask);
  put_string(answer, arguments);
  put_char(answer, ',');
  put_int(answer, core_clock_us());
  return CODE_OK;
}

COMMAND(do_safe_eyes) {
  (void)answer;
  enum eyes before = unit.eyes;
  if (equals_word(arguments, P("OPEN")))
    unit.eyes = EYES_OPEN;
  else if (equals_word(arguments, P("CLOSED")))
    unit.eyes = EYES_CLOSED;
  else if (equals_word(arguments, P("SHIELDED")))
    unit.eyes = EYES_SHIELDED;
  else
    return refuse(CODE_SYNTAX, P("expected OPEN or CLOSED or SHIELDED"));
  unit.armed = false;
  /* what runs was judged for eyes that were not open */
  if (unit.eyes == EYES_OPEN && before != EYES_OPEN) box_go_dark();
  return CODE_OK;
}

COMMAND(get_safe_eyes) {
  UNUSED;
  put_flash(answer, unit.eyes == EYES_OPEN     ? P("OPEN")
                    : unit.eyes == EYES_CLOSED ? P("CLOSED")
                                               : P("SHIELDED"));
  return CODE_OK;
}

COMMAND(get_led_fail) {
  UNUSED;
  for (uint16_t digits = (LEDS + 3) / 4; digits--;) {
    uint8_t digit = 0;
    for (uint8_t k = 0; k < 4; k++) {
      uint16_t led = (uint16_t)(4 * digits + k);
      if (led < LEDS && bank_has_failed(led)) digit |= (uint8_t)(1u << k);
    }
    put_hex(answer, digit, 1, true);
  }
  return CODE_OK;
}

COMMAND(get_dose) {
  uint32_t led;
  TRY(parse_integer(arguments, 0, LEDS - 1, &led));
  put_real(answer, bank_dose_ws((uint16_t)led), 6);
  return CODE_OK;
}

COMMAND(do_dose_new) {
  (void)answer;
  TRY(parse_token(arguments));
  TRY(refuse_running());
  bank_new_subject();
  unit.eyes = EYES_OPEN; /* the statement was of the previous subject */
  unit.armed = false;    /* the table was judged with it */
  return CODE_OK;
}
