/* Boxes with LEDs: the bank with its limits, the eyes' guard, and the table's sequencer. */
#ifndef FIRMWARE_LED_H
#define FIRMWARE_LED_H

#include "boxes/box.h"

#define LEVEL_STEPS 1000
#define ROW_MIN_US 2000
#define LED_DEFAULT_US 100000
/* Pulses of the last second that the driver remembers; a pattern is one of each LED. */
#ifdef QUARTER_TURN_US
#define HISTORY 16384
#else
#define HISTORY 4096
#endif
#define LED_PULSES 1700    /* of one LED: a table's and the history's */
#define LIGHT_CHANGES 4096 /* distinct times at which a judged light changes */

/* One row of the table. */
struct row {
  uint32_t dwell_us, mask;
  uint16_t level; /* thousandths, 0 when dark */
#ifdef QUARTER_TURN_US
  uint8_t pattern;
  int32_t reading_mdeg;
#else
  uint8_t count; /* of the LEDs, ascending */
  uint8_t leds[MAX_AT_ONCE];
#endif
};

struct pulse {
  double level;
  us_t on, off;
  uint16_t led;
};

/* A requested light gives its pulses to `visit`, in order: those of one LED, or of all (-1). */
typedef void visit_pulse(const struct pulse *pulse, void *context);
typedef void requested_light(int32_t only, visit_pulse *visit, void *context);

struct loads {
  double duty, heat, dose_ws;
};

/* bank */
void bank_build(void);
bool bank_is_lit(uint16_t led);
bool bank_any_lit(void);
bool bank_has_tripped(void);
double bank_dose_ws(uint16_t led);
void bank_new_subject(void);
us_t bank_deadline(void);
bool bank_advance(void); /* false: a driver has tripped, LED:HOT was sent */
/* Put out what is due, while a long judgment lets no time pass for the core. */
void bank_keep_ends(void);
/* false: it is newly found to draw no current, LED:FAIL was sent; it is not driven again */
bool bank_switch_on(uint16_t led, double level, us_t end);
bool bank_has_failed(uint16_t led);
void bank_forget_failed(void);
void bank_switch_off(uint16_t led);
void bank_all_off(void);
/* Pulses since a time, and those in progress that have an end. */
void bank_visit_since(us_t start, visit_pulse *visit, void *context);
enum code bank_require_within_limits(requested_light *light, struct loads *most);

/* eyes */
void guard_start(requested_light *past, requested_light *light);
bool guard_continue(void); /* judge a part, of some ms at most; true: more are left */
double guard_flashes_per_s(void); /* half the reversals in the worst second */
double guard_rms(void);           /* of the 3 to 65 Hz part, over the mean */
bool guard_is_full(void);         /* the light had too many changes to be judged */

/* sequencer */
extern struct row table[MAX_ROWS];
uint16_t sequencer_rows(void);
enum code refuse_running(void);
void disarm_sequence(void);
enum code require_flicker_limits(requested_light *light);
bool sequencer_is_lit(void);
uint16_t sequencer_status(void);
void sequencer_reset(bool power_up);
/* Level, time and mask of a row, as text and checked. */
enum code parse_row_light(const char *level, const char *dwell, const char *mask, bool is_dark,
                          struct row *row);
enum code refuse_above(flash_text before, int64_t limit, flash_text after);

/* What the kind of box adds. */
enum action { NOTHING, EARLY_ON, TURN, ROTATE, LIGHT, PULSE, END };
struct step {
  us_t at; /* since the run's start */
  enum action action;
  uint16_t row;
};
void kind_first_step(struct step *step);
void kind_next_step(struct step *step); /* from one step to the next; none is left: NOTHING */
void kind_switch(const struct step *step);
requested_light table_light;
enum code kind_require_ready(void); /* before a table is judged */
enum code parse_row(char *text, struct row *row);
void put_row(struct text *text, const struct row *row);

#endif
