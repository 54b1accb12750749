/* The gradient sphere: patterns of all LEDs, gains, and an analyzer that turns in the dark. */
#include <string.h>

#include "boxes/led.h"

#define FIELDS 5
#define PATTERNS 8
#define DARK 7

static const FLASH char NAMES[PATTERNS][5] = {"FULL", "X", "Y", "Z", "-X", "-Y", "-Z", "DARK"};

static KEPT struct {
  int32_t reading_mdeg;
  us_t settled_at;
} kept;

static STATE struct {
  uint16_t gains[LEDS], gains_sent;
  uint8_t shining;
  /* the light that PATT asks for */
  uint8_t pattern;
  double level;
  us_t end;
  /* the scan's next row: when its light begins, and the reading that the scan has reached */
  us_t lit_at;
  int32_t reading_mdeg;
} unit;

void box_build(void) {
  bank_build();
  kept.reading_mdeg = 0;
  kept.settled_at = core_now();
}

static void turn(int32_t reading_mdeg) {
  us_t start = later(core_now(), kept.settled_at);
  kept.settled_at = start + rotation_us(kept.reading_mdeg, reading_mdeg);
  kept.reading_mdeg = reading_mdeg;
  board_turn(reading_mdeg);
}

static void clear_gains(void) {
  for (uint16_t led = 0; led < LEDS; led++) unit.gains[led] = LEVEL_STEPS;
  unit.gains_sent = 0;
}

void box_reset(bool power_up) {
  sequencer_reset(power_up);
  memset(&unit, 0, sizeof unit);
  clear_gains();
  turn(0);
}

static bool is_turning(void) { return core_now() < kept.settled_at; }
bool box_is_busy(void) { return refuse_running() != CODE_OK || is_turning(); }
uint16_t box_status(void) { return (uint16_t)(sequencer_status() | is_turning() << 10); }

enum code kind_require_ready(void) {
  if (!is_turning()) return CODE_OK;
  refuse(CODE_IGNORED, P("analyzer turning, "));
  put_int(reason(), ceil_ms(kept.settled_at - core_now()));
  put_flash(reason(), P(" ms"));
  return CODE_IGNORED;
}

/* light ----------------------------------------------------------------------------------- */

static double level_of(const struct row *row) { return (double)row->level / LEVEL_STEPS; }

static double driven_level(uint16_t led, uint8_t pattern, double level) {
  return level * ((double)unit.gains[led] / LEVEL_STEPS) * PATTERN_SHARE[pattern][led];
}

/* Replace the light by a pattern; false: an LED is newly found to draw no current. */
static bool start_pattern(uint8_t pattern, double level, us_t end) {
  bool works = true;
  bank_all_off();
  if (pattern == DARK) return true;
  unit.shining = pattern;
  for (uint16_t led = 0; led < LEDS; led++)
    works &= bank_switch_on(led, driven_level(led, pattern, level), end);
  return works;
}

static void visit_pattern(uint8_t pattern, double level, us_t on, us_t off, int32_t only,
                          visit_pulse *visit, void *context) {
  if (pattern == DARK) return;
  uint16_t first = only < 0 ? 0 : (uint16_t)only;
  uint16_t last = only < 0 ? LEDS - 1 : (uint16_t)only;
  for (uint16_t led = first; led <= last; led++) {
    struct pulse pulse = {driven_level(led, pattern, level), on, off, led};
    if (pulse.level > 0.0 && !bank_has_failed(led)) visit(&pulse, context);
  }
}

static void single_light(int32_t only, visit_pulse *visit, void *context) {
  visit_pattern(unit.pattern, unit.level, core_now(), unit.end, only, visit, context);
}

static enum code parse_pattern(const char *text, uint8_t *pattern) {
  for (*pattern = 0; *pattern < PATTERNS; ++*pattern)
    if (equals_word(text, NAMES[*pattern])) return CODE_OK;
  refuse(CODE_SYNTAX, P("expected "));
  for (uint8_t k = 0; k < PATTERNS; k++) {
    if (k) put_flash(reason(), P(" or "));
    put_flash(reason(), NAMES[k]);
  }
  return CODE_SYNTAX;
}

COMMAND(do_patt) {
  (void)answer;
  int64_t span = LED_DEFAULT_US;
  uint32_t level = LEVEL_STEPS;
  struct loads loads;
  TRY(refuse_running());
  char *length = cut(arguments, ',');
  char *steps = length ? cut(length, ',') : NULL;
  if (steps && cut(steps, ',')) return refuse(CODE_SYNTAX, P("expected PATTERN,MS,LEVEL"));
  TRY(parse_pattern(arguments, &unit.pattern));
  if (unit.pattern == DARK) {
    if (length) return refuse(CODE_SYNTAX, P("expected DARK"));
    bank_all_off();
    return CODE_OK;
  }
  if (length)
    TRY(parse_number(length, NANO, (int64_t)LED_MAX_US * (NANO / 1000), P("ms"), 3, &span));
  if (steps) TRY(parse_integer(steps, 1, LEVEL_STEPS, &level));
  TRY(refuse_open_stop());
  TRY(kind_require_ready());
  unit.level = (double)level / LEVEL_STEPS;
  unit.end = core_now() + span;
  TRY(bank_require_within_limits(single_light, &loads));
  TRY(require_flicker_limits(single_light));
  disarm_sequence();
  start_pattern(unit.pattern, unit.level, unit.end);
  return CODE_OK;
}

COMMAND(get_patt) {
  UNUSED;
  put_flash(answer, NAMES[bank_any_lit() ? unit.shining : DARK]);
  return CODE_OK;
}

/* scans ----------------------------------------------------------------------------------- */

/* "0" to "999.999" degrees, digits as the row's pattern has them. */
static bool is_reading(const char *text) {
  uint8_t whole = 0, decimals = 0;
  while (is_digit(*text)) text++, whole++;
  bool point = *text == '.';
  if (point) text++;
  while (point && is_digit(*text)) text++, decimals++;
  return !*text && whole >= 1 && whole <= 3 && (!point || (decimals >= 1 && decimals <= 3));
}

static bool is_word(const char *text) {
  uint8_t length = 0;
  for (; *text; text++, length++)
    if (length == 4 || !((upper(*text) >= 'A' && upper(*text) <= 'Z') || *text == '-'))
      return false;
  return length >= 1;
}

enum code parse_row(char *text, struct row *row) {
  char *fields[FIELDS] = {text, NULL, NULL, NULL, NULL};
  uint32_t number;
  int64_t mdeg;
  for (uint8_t k = 1; k < FIELDS && fields[k - 1]; k++) fields[k] = cut(fields[k - 1], ':');
  if (!fields[4] || !is_word(text) || !is_reading(fields[1]) ||
      !parse_digits(fields[2], 4, &number) || !parse_digits(fields[3], 7, &number) ||
      !parse_hex(fields[4], &number))
    return refuse(CODE_SYNTAX, P("expected PATTERN:DEGREES:LEVEL:US:MASK;..."));
  TRY(parse_pattern(text, &row->pattern));
  TRY(parse_number(fields[1], 0, 180 * NANO, P("degrees"), 3, &mdeg));
  row->reading_mdeg = (int32_t)mdeg;
  return parse_row_light(fields[2], fields[3], fields[4], row->pattern == DARK, row);
}

/* An angle without zeros at its end. */
static void put_angle(struct text *text, int32_t mdeg) {
  uint8_t digits = 3;
  while (digits && mdeg % 10 == 0) mdeg /= 10, digits--;
  put_fixed(text, mdeg, digits);
}

void put_row(struct text *text, const struct row *row) {
  put_flash(text, NAMES[row->pattern]);
  put_char(text, ':');
  put_angle(text, row->reading_mdeg);
  put_char(text, ':');
  put_int(text, row->level);
  put_char(text, ':');
  put_int(text, row->dwell_us);
  put_char(text, ':');
  put_hex(text, row->mask, 1, true);
}

void table_light(int32_t only, visit_pulse *visit, void *context) {
  us_t at = core_now();
  int32_t reading = kept.reading_mdeg;
  for (uint16_t place = 0; place < sequencer_rows(); place++) {
    const struct row *row = &table[place];
    at += rotation_us(reading, row->reading_mdeg);
    reading = row->reading_mdeg;
    visit_pattern(row->pattern, level_of(row), at, at + row->dwell_us, only, visit, context);
    at += row->dwell_us;
  }
}

/* Begin a row at a time: dark and turning first, where it needs another reading. */
static void begin_row(struct step *step, us_t at, uint16_t row) {
  int32_t reading = table[row].reading_mdeg;
  unit.lit_at = at + rotation_us(unit.reading_mdeg, reading);
  unit.reading_mdeg = reading;
  *step = (struct step){at, unit.lit_at == at ? LIGHT : ROTATE, row};
}

void kind_first_step(struct step *step) {
  unit.reading_mdeg = kept.reading_mdeg;
  begin_row(step, 0, 0);
}

void kind_next_step(struct step *step) {
  us_t over = unit.lit_at + table[step->row].dwell_us;
  if (step->action == ROTATE) {
    *step = (struct step){unit.lit_at, LIGHT, step->row};
  } else if (step->action == LIGHT) {
    *step = (struct step){unit.lit_at + SETTLE_US, PULSE, step->row};
  } else if (step->row + 1 < sequencer_rows()) {
    begin_row(step, over, (uint16_t)(step->row + 1));
  } else {
    *step = (struct step){over, END, step->row};
  }
}

void kind_switch(const struct step *step) {
  const struct row *row = &table[step->row];
  if (step->action == ROTATE) {
    bank_all_off();
    turn(row->reading_mdeg);
  } else if (!start_pattern(row->pattern, level_of(row), NEVER)) {
    box_go_dark();
  }
}

/* analyzer and gains ---------------------------------------------------------------------- */

COMMAND(do_pol_ang) {
  (void)answer;
  int64_t mdeg;
  TRY(parse_number(arguments, 0, 180 * NANO, P("degrees"), 3, &mdeg));
  TRY(refuse_running());
  if (bank_any_lit()) return refuse(CODE_IGNORED, P("a light is on; PATT DARK first"));
  disarm_sequence();
  turn((int32_t)mdeg);
  return CODE_OK;
}

COMMAND(do_pol) {
  if (!equals_word(arguments, P("0")) && !equals_word(arguments, P("90")))
    return refuse(CODE_SYNTAX, P("expected 0 or 90"));
  return do_pol_ang(arguments, answer);
}

COMMAND(get_pol) {
  UNUSED;
  put_fixed(answer, kept.reading_mdeg, 3);
  return CODE_OK;
}

COMMAND(do_gain_cle) {
  UNUSED;
  TRY(refuse_running());
  clear_gains();
  disarm_sequence();
  return CODE_OK;
}

/* Count gains joined by "+", and find the largest; with a target, store them. 0: not such. */
static uint16_t parse_gains(char *text, uint16_t *target, uint32_t *largest) {
  uint16_t count = 0;
  *largest = 0;
  for (char *rest; text; text = rest) {
    uint32_t gain;
    rest = cut(text, '+');
    bool good = parse_digits(text, 4, &gain);
    if (rest) rest[-1] = '+';
    if (!good) return 0;
    if (gain > *largest) *largest = gain;
    if (target) target[count] = (uint16_t)gain;
    count++;
  }
  return count;
}

COMMAND(do_gain_def) {
  (void)answer;
  uint32_t first, largest;
  TRY(refuse_running());
  char *rest = cut(arguments, ',');
  uint16_t count = rest ? parse_gains(rest, NULL, &largest) : 0;
  if (!count) return refuse(CODE_SYNTAX, P("expected FIRST,GAIN+GAIN..."));
  TRY(parse_integer(arguments, 0, unit.gains_sent, &first));
  if (first + count > LEDS || largest > LEVEL_STEPS)
    return refuse_above(P("expected 0 to 1000 for "), LEDS, P(" LEDs"));
  parse_gains(rest, &unit.gains[first], &largest);
  if (first + count > unit.gains_sent) unit.gains_sent = (uint16_t)(first + count);
  disarm_sequence();
  return CODE_OK;
}

COMMAND(get_gain_crc) {
  UNUSED;
  uint16_t crc = 0xFFFFu;
  for (uint16_t k = 0; k < unit.gains_sent; k++) {
    char data[8];
    struct text text;
    text_start(&text, data, sizeof data);
    if (k) put_char(&text, '\n');
    put_int(&text, unit.gains[k]);
    crc = crc16(crc, data, text.used);
  }
  put_int(answer, unit.gains_sent);
  put_char(answer, ',');
  put_hex(answer, crc, 4, true);
  return CODE_OK;
}
