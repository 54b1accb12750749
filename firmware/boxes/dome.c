/* The dome: single LEDs, and a table of them that never leaves the eyes in the dark. */
#include <string.h>

#include "boxes/led.h"

#define FIELDS 4

static STATE struct {
  /* the next row of each kind of step, and when it is due since the start */
  uint16_t on_row, turn_row, pulse_row;
  us_t on_at, turn_at, pulse_at;
  /* the light that LED:ON asks for */
  uint8_t leds[MAX_AT_ONCE], count;
  double level;
  us_t end;
} unit;

void box_build(void) { bank_build(); }

void box_reset(bool power_up) {
  sequencer_reset(power_up);
  memset(&unit, 0, sizeof unit);
}

bool box_is_busy(void) { return refuse_running() != CODE_OK; }
uint16_t box_status(void) { return sequencer_status(); }
enum code kind_require_ready(void) { return CODE_OK; }

/* rows ------------------------------------------------------------------------------------ */

static bool is_led_list(const char *text) {
  for (; *text; text++)
    if (!is_digit(*text) && *text != '+') return false;
  return true;
}

static enum code refuse_led_list(void) {
  return refuse(CODE_SYNTAX, P("expected LED numbers joined by +"));
}

/* Parse "3+17" to ascending numbers; how many there are may exceed those kept. */
static enum code parse_leds(char *text, uint8_t leds[MAX_AT_ONCE], uint8_t *count) {
  static uint32_t numbers[512];
  uint16_t found = 0;
  bool twice = false;
  if (!is_led_list(text)) return refuse_led_list();
  for (char *rest; text; text = rest) {
    uint32_t led;
    rest = cut(text, '+');
    if (!parse_digits(text, 4, &led)) return refuse_led_list();
    uint16_t place = found++;
    for (; place && numbers[place - 1] > led; place--) numbers[place] = numbers[place - 1];
    twice |= place && numbers[place - 1] == led;
    numbers[place] = led;
  }
  if (twice) return refuse(CODE_SYNTAX, P("an LED is listed twice"));
  if (numbers[found - 1] >= LEDS) return refuse_above(P("expected LED 0 to "), LEDS - 1, P(""));
  if (found > MAX_AT_ONCE)
    return refuse_above(P("expected at most "), MAX_AT_ONCE, P(" LEDs at once"));
  for (uint16_t k = 0; k < found; k++) leds[k] = (uint8_t)numbers[k];
  *count = (uint8_t)found;
  return CODE_OK;
}

enum code parse_row(char *text, struct row *row) {
  char *fields[FIELDS] = {text, NULL, NULL, NULL};
  uint32_t number;
  for (uint8_t k = 1; k < FIELDS && fields[k - 1]; k++) fields[k] = cut(fields[k - 1], ':');
  bool dark = equals_word(text, P("-"));
  size_t length = strlen(text);
  if (!fields[3] || !(dark || (length >= 1 && length <= 400 && is_led_list(text))) ||
      !parse_digits(fields[1], 4, &number) || !parse_digits(fields[2], 7, &number) ||
      !parse_hex(fields[3], &number))
    return refuse(CODE_SYNTAX, P("expected LEDS:LEVEL:US:MASK;..."));
  row->count = 0;
  if (!dark) TRY(parse_leds(text, row->leds, &row->count));
  return parse_row_light(fields[1], fields[2], fields[3], dark, row);
}

static void put_leds(struct text *text, const uint8_t *leds, uint8_t count) {
  for (uint8_t k = 0; k < count; k++) {
    if (k) put_char(text, '+');
    put_int(text, leds[k]);
  }
  if (count == 0) put_char(text, '-');
}

void put_row(struct text *text, const struct row *row) {
  put_leds(text, row->leds, row->count);
  put_char(text, ':');
  put_int(text, row->level);
  put_char(text, ':');
  put_int(text, row->dwell_us);
  put_char(text, ':');
  put_hex(text, row->mask, 1, true);
}

static double level_of(const struct row *row) { return (double)row->level / LEVEL_STEPS; }

static bool has_led(const struct row *row, uint16_t led) {
  for (uint8_t k = 0; k < row->count; k++)
    if (row->leds[k] == led) return true;
  return false;
}

/* The light of the table if it began now: per LED without gaps or overlap. */
void table_light(int32_t only, visit_pulse *visit, void *context) {
  static struct pulse going[2 * MAX_AT_ONCE];
  uint8_t count = 0;
  us_t at = core_now();
  for (uint16_t place = 0; place <= sequencer_rows(); place++) {
    const struct row *row = place < sequencer_rows() ? &table[place] : NULL;
    const struct row *before = place ? &table[place - 1] : NULL;
    uint8_t kept = 0;
    for (uint8_t k = 0; k < count; k++) {
      struct pulse pulse = going[k];
      if (row && has_led(row, pulse.led) && pulse.level == level_of(row)) {
        going[kept++] = pulse;
        continue;
      }
      pulse.off = at;
      visit(&pulse, context);
    }
    count = kept;
    for (uint8_t k = 0; row && k < row->count; k++) {
      uint16_t led = row->leds[k];
      bool goes_on = bank_has_failed(led) || (only >= 0 && led != (uint32_t)only);
      for (uint8_t j = 0; j < count; j++) goes_on |= going[j].led == led;
      if (goes_on) continue;
      us_t early = before && !has_led(before, led) ? OVERLAP_US : 0;
      going[count++] = (struct pulse){level_of(row), at - early, 0, led};
    }
    if (row) at += row->dwell_us;
  }
}

/* steps: the next row's LEDs early, the turn to it, its cameras ---------------------------- */

void kind_first_step(struct step *step) {
  unit.on_row = 1;
  unit.on_at = (us_t)table[0].dwell_us - OVERLAP_US;
  unit.turn_row = unit.pulse_row = 0;
  unit.turn_at = 0;
  unit.pulse_at = SETTLE_US;
  kind_next_step(step);
}

void kind_next_step(struct step *step) {
  uint16_t rows = sequencer_rows();
  /* of steps at one time the one that is earlier in the rows, and early light, turn, cameras */
  us_t on = unit.on_row < rows ? unit.on_at : NEVER;
  us_t pulse = unit.pulse_row < rows ? unit.pulse_at : NEVER;
  us_t turn = unit.turn_at; /* of the row after the last one: the end */
  bool on_first = on < pulse || (on == pulse && unit.on_row <= unit.pulse_row);
  if (on_first && on != NEVER && (on < turn || (on == turn && unit.on_row <= unit.turn_row))) {
    *step = (struct step){on, EARLY_ON, unit.on_row};
    unit.on_at += table[unit.on_row++].dwell_us;
  } else if (pulse < turn || (pulse == turn && unit.pulse_row < unit.turn_row)) {
    *step = (struct step){pulse, PULSE, unit.pulse_row};
    unit.pulse_at += table[unit.pulse_row++].dwell_us;
  } else {
    bool over = unit.turn_row == rows;
    *step = (struct step){turn, over ? END : TURN, (uint16_t)(unit.turn_row - over)};
    if (!over) unit.turn_at += table[unit.turn_row++].dwell_us;
  }
}

void kind_switch(const struct step *step) {
  const struct row *row = &table[step->row], *before = step->row ? row - 1 : NULL;
  bool early = step->action == EARLY_ON, works = true;
  for (uint8_t k = 0; !early && before && k < before->count; k++)
    if (!has_led(row, before->leds[k])) bank_switch_off(before->leds[k]);
  for (uint8_t k = 0; k < row->count; k++) {
    bool held = before && has_led(before, row->leds[k]);
    bool changes = !before || (held && before->level != row->level);
    if (early ? !held : changes) works &= bank_switch_on(row->leds[k], level_of(row), NEVER);
  }
  if (!works) box_go_dark();
}

/* single LEDs ----------------------------------------------------------------------------- */

static void single_light(int32_t only, visit_pulse *visit, void *context) {
  for (uint8_t k = 0; k < unit.count; k++) {
    struct pulse pulse = {unit.level, core_now(), unit.end, unit.leds[k]};
    if (only < 0 || pulse.led == (uint32_t)only) visit(&pulse, context);
  }
}

static enum code require_few(void) {
  uint16_t count = unit.count;
  for (uint16_t led = 0; led < LEDS; led++) {
    bool asked = false;
    for (uint8_t k = 0; k < unit.count; k++) asked |= unit.leds[k] == led;
    count = (uint16_t)(count + (bank_is_lit(led) && !asked));
  }
  if (count <= MAX_AT_ONCE) return CODE_OK;
  return refuse_above(P("more than "), MAX_AT_ONCE, P(" LEDs at once"));
}

COMMAND(do_led_on) {
  (void)answer;
  int64_t span = LED_DEFAULT_US;
  uint32_t level = LEVEL_STEPS;
  struct loads loads;
  TRY(refuse_running());
  char *length = cut(arguments, ',');
  char *steps = length ? cut(length, ',') : NULL;
  if (steps && cut(steps, ',')) return refuse(CODE_SYNTAX, P("expected LEDS,MS,LEVEL"));
  unit.count = 0;
  TRY(parse_leds(arguments, unit.leds, &unit.count));
  if (length)
    TRY(parse_number(length, NANO, (int64_t)LED_MAX_US * (NANO / 1000), P("ms"), 3, &span));
  if (steps) TRY(parse_integer(steps, 1, LEVEL_STEPS, &level));
  TRY(require_few());
  TRY(refuse_open_stop());
  for (uint8_t k = 0; k < unit.count; k++) {
    if (!bank_has_failed(unit.leds[k]) && board_set_led(unit.leds[k], -1.0)) continue;
    refuse(CODE_HARDWARE, P("LED "));
    put_int(reason(), unit.leds[k]);
    put_flash(reason(), P(" draws no current"));
    return CODE_HARDWARE;
  }
  unit.level = (double)level / LEVEL_STEPS;
  unit.end = core_now() + span;
  TRY(bank_require_within_limits(single_light, &loads));
  TRY(require_flicker_limits(single_light));
  disarm_sequence();
  for (uint8_t k = 0; k < unit.count; k++) bank_switch_on(unit.leds[k], unit.level, unit.end);
  return CODE_OK;
}

COMMAND(do_led_off) {
  (void)answer;
  uint8_t leds[MAX_AT_ONCE], count = 0;
  bool all = equals_word(arguments, P("ALL"));
  if (!all) TRY(parse_leds(arguments, leds, &count));
  TRY(refuse_running());
  if (all) {
    for (uint16_t led = 0; led < LEDS; led++) bank_switch_off(led);
  }
  for (uint8_t k = 0; k < count; k++) bank_switch_off(leds[k]);
  return CODE_OK;
}

COMMAND(get_led) {
  UNUSED;
  uint8_t leds[MAX_AT_ONCE], count = 0;
  for (uint16_t led = 0; led < LEDS; led++)
    if (bank_is_lit(led) && count < MAX_AT_ONCE) leds[count++] = (uint8_t)led;
  put_leds(answer, leds, count);
  return CODE_OK;
}
