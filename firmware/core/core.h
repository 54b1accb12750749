/* The protocol of every box: lines, frames, kept answers, lease, arming and errors.
 *
 * Bytes and microseconds in, bytes out. The core opens nothing and never waits.
 */
#ifndef FIRMWARE_CORE_H
#define FIRMWARE_CORE_H

#include "core/text.h"

/* State that a test host exchanges as a whole, to run several boxes in one process. */
#ifdef FIRMWARE_HOST
#define STATE __attribute__((section("firmware_state")))
#else
#define STATE
#endif
/* State that survives a reset of the processor: counts, heat, charge, rest. */
#ifdef __AVR__
#define KEPT __attribute__((section(".noinit")))
#else
#define KEPT STATE
#endif

typedef int64_t us_t;
#define NEVER INT64_MAX

enum code {
  CODE_OK = 0,
  CODE_SYNTAX = -102,
  CODE_UNDEFINED_HEADER = -113,
  CODE_NOT_ARMED = -203,
  CODE_IGNORED = -213,
  CODE_OUT_OF_RANGE = -222,
  CODE_HARDWARE = -240,
  CODE_QUEUE_OVERFLOW = -350,
  CODE_DUTY = 101,
  CODE_THERMAL = 102,
  CODE_RECYCLE = 103,
  CODE_LIGHT_DOSE = 104,
  CODE_FLICKER = 105,
  CODE_FORCE = 106,
  CODE_INTERLOCK = 107,
  CODE_WATCHDOG_TRIPPED = 108,
  CODE_BOOT_CHANGED = 201,
  CODE_SEQ_REUSED = 202,
  CODE_UNFRAMED = 203,
  CODE_BAD_CRC = 204,
  CODE_PENDING = 1000 /* answered later; see box_pending */
};

#define ARMED 1u /* refused unless armed */
#define BARE 2u  /* accepted without a frame, as for going dark */

/* A command writes its payload to `answer`, or refuses. It may change its arguments. */
typedef enum code command_handler(char *arguments, struct text *answer);

/* For main(). */
void core_power_up(us_t now, bool cold);
void core_announce(us_t now);
void core_feed(const char *bytes, uint16_t size, us_t now);
void core_advance(us_t now);
us_t core_deadline(void);
void core_handle_framed_line(char *line, uint16_t size); /* a line without its newline */
void core_handle_bare_line(char *line, uint16_t size);

#ifdef FIRMWARE_HOST
void core_ask(void (*handle)(char *, uint16_t), char *line, uint16_t size);
#endif

/* For boxes. */
us_t core_now(void);
us_t core_clock_us(void); /* since power-up */
void core_update_clock(void); /* before an act that times others: parsing took time */
/* Refuse with the text of a code and "; detail"; `reason` may be added to. */
enum code refuse(enum code code, flash_text detail);
struct text *reason(void);
/* Begin, and end, the payload of an event that follows the answer. */
struct text *event_start(flash_text name);
void event_end(void);
enum code refuse_open_stop(void);
bool core_stop_opens(void); /* true once for each opening of the emergency stop */
bool core_lease_is_over(us_t now);
/* A number from low to high (nano-units) as a multiple of 10^-digits, halves rounded up. */
enum code parse_number(const char *text, int64_t low, int64_t high, flash_text unit,
                       uint8_t digits, int64_t *value);
enum code parse_integer(const char *text, int64_t low, int64_t high, uint32_t *value);
enum code parse_token(const char *text);
us_t ceil_ms(us_t duration);
double seconds_of(us_t duration);
us_t round_us(double seconds);

/* For the core: what each box provides. */
void box_build(void); /* the state that survives, as of a first power-up */
void box_reset(bool power_up);
void box_go_dark(void);
void box_advance(void);
us_t box_deadline(void);
bool box_is_busy(void);
uint16_t box_status(void);
/* When the answer of a pending command is due, and that answer. */
us_t box_pending_due(void);
enum code box_pending_outcome(struct text *answer);

#endif
