#include "core/core.h"

#include <math.h>
#include <string.h>

#include "boards/board.h"
#include "limits.h"

#define LINE_BYTES 1024u
#define KEPT_ANSWERS 8u
#define KEPT_BYTES 160u
#define HELLOS 8u
#define ERRORS 16u
#ifdef __AVR__
#define ERROR_BYTES 72u
#define EVENT_BYTES 256u
#else
#define ERROR_BYTES 112u
#define EVENT_BYTES 4096u
#endif
#define CAPABILITY_CHUNK 48u
#define LEASE_MIN_MS 300
#define LEASE_MAX_MS 5000
#define LEASE_DEFAULT_MS 1000

struct request {
  uint32_t seq;
  uint32_t hash;
  uint16_t length;
};

struct kept_answer {
  struct request request;
  uint16_t size;
  char data[KEPT_BYTES];
};

struct error {
  int16_t code;
  char reason[ERROR_BYTES];
};

static STATE struct core {
  us_t now, powered_at, lease_end;
  char line[LINE_BYTES];
  uint16_t line_used;
  bool discarding, armed, tripped, pending, stop_seen;
  uint16_t boot, lease_ms;
  uint32_t events;
  struct request under_way;
  struct kept_answer kept[KEPT_ANSWERS];
  uint8_t kept_next;
  uint32_t latest_seq, hellos[HELLOS];
  uint8_t hellos_next, hellos_count;
  bool heard; /* latest_seq is valid */
  struct error errors[ERRORS];
  uint8_t errors_first, errors_count;
  char event_data[EVENT_BYTES];
  struct text event;
  char reason_data[ERROR_BYTES];
  struct text reason;
  char answer_data[LINE_BYTES + 1];
} core;

/* commands ------------------------------------------------------------------------------- */

struct command {
  flash_text name, arguments, harmless;
  command_handler *run;
  uint8_t needs;
};

#define X(id, name, arguments, needs, harmless)     \
  command_handler id;                               \
  static const FLASH char id##_name[] = name;       \
  static const FLASH char id##_args[] = arguments;  \
  static const FLASH char id##_dark[] = harmless;
BOX_COMMANDS(X)
#undef X
#define X(id, name, arguments, needs, harmless) {id##_name, id##_args, id##_dark, id, needs},
static const FLASH struct command COMMANDS[] = {BOX_COMMANDS(X)};
#undef X
#define COMMAND_COUNT (sizeof COMMANDS / sizeof COMMANDS[0])

static const FLASH char CAPABILITIES[] = BOX_CAPABILITIES;

#ifdef FIRMWARE_HOST
/* A bare query, or a refused frame, leaves no trace: not in the log of errors either. */
void core_ask(void (*handle)(char *, uint16_t), char *line, uint16_t size) {
  static struct core before;
  before = core;
  handle(line, size);
  core = before;
}
#endif

us_t core_now(void) { return core.now; }
void core_update_clock(void) {
  us_t now = board_now_us();
  if (now > core.now) core.now = now;
}
us_t core_clock_us(void) { return core.now - core.powered_at; }
us_t ceil_ms(us_t duration) { return -floor_divide(-duration, 1000); }
double seconds_of(us_t duration) { return (double)duration / 1e6; }
us_t round_us(double seconds) { return (us_t)floor(1e6 * seconds + 0.5); }

struct text *reason(void) { return &core.reason; }

static flash_text text_of(enum code code) {
  switch (code) {
    case CODE_SYNTAX: return P("Syntax error");
    case CODE_UNDEFINED_HEADER: return P("Undefined header");
    case CODE_NOT_ARMED: return P("Command protected; SYST:ARM first");
    case CODE_IGNORED: return P("Init ignored");
    case CODE_OUT_OF_RANGE: return P("Data out of range");
    case CODE_HARDWARE: return P("Hardware error");
    case CODE_QUEUE_OVERFLOW: return P("Queue overflow");
    case CODE_DUTY: return P("Duty limit");
    case CODE_THERMAL: return P("Too hot");
    case CODE_RECYCLE: return P("Recycling");
    case CODE_LIGHT_DOSE: return P("Light dose");
    case CODE_FLICKER:
      return P("Flicker; set SAFE:EYES to CLOSED or SHIELDED once eyes are safe");
    case CODE_FORCE: return P("Force limit");
    case CODE_INTERLOCK: return P("Interlock open");
    case CODE_WATCHDOG_TRIPPED: return P("Watchdog tripped; SYST:ARM first");
    case CODE_BOOT_CHANGED: return P("Boot changed; SYST:HELLO? first");
    case CODE_SEQ_REUSED: return P("Sequence number reused");
    case CODE_UNFRAMED: return P("Unframed command");
    default: return P("Bad frame");
  }
}

enum code refuse(enum code code, flash_text detail) {
  text_start(&core.reason, core.reason_data, ERROR_BYTES);
  put_flash(&core.reason, text_of(code));
  if (*detail) put_flash(&core.reason, P("; "));
  put_flash(&core.reason, detail);
  return code;
}

enum code refuse_open_stop(void) {
  return board_stop_is_open() ? refuse(CODE_INTERLOCK, P("")) : CODE_OK;
}

bool core_stop_opens(void) {
  bool before = core.stop_seen;
  core.stop_seen = board_stop_is_open();
  return core.stop_seen && !before;
}

bool core_lease_is_over(us_t now) { return now >= core.lease_end; }

static enum code refuse_range(int64_t low, int64_t high, uint8_t digits) {
  refuse(CODE_OUT_OF_RANGE, P("expected "));
  put_general(&core.reason, low, digits);
  put_flash(&core.reason, P(" to "));
  put_general(&core.reason, high, digits);
  return CODE_OUT_OF_RANGE;
}

enum code parse_number(const char *text, int64_t low, int64_t high, flash_text unit,
                       uint8_t digits, int64_t *value) {
  int64_t nano;
  if (!parse_nano(text, &nano)) return refuse(CODE_SYNTAX, P("expected a number"));
  if (nano < low || nano > high) {
    refuse_range(low, high, 9);
    put_char(&core.reason, ' ');
    put_flash(&core.reason, unit);
    return CODE_OUT_OF_RANGE;
  }
  *value = round_nano(nano, digits);
  return CODE_OK;
}

enum code parse_integer(const char *text, int64_t low, int64_t high, uint32_t *value) {
  if (!parse_digits(text, 9, value)) return refuse(CODE_SYNTAX, P("expected a whole number"));
  if ((int64_t)*value < low || (int64_t)*value > high) return refuse_range(low, high, 0);
  return CODE_OK;
}

enum code parse_token(const char *text) {
  uint8_t length = 0;
  for (; *text; text++, length++) {
    char letter = upper(*text);
    bool good = is_digit(letter) || (letter >= 'A' && letter <= 'Z') || letter == '.' ||
                letter == '_' || letter == '-';
    if (!good || length == 48) length = 99;
    if (length == 99) break;
  }
  if (length >= 1 && length <= 48) return CODE_OK;
  return refuse(CODE_SYNTAX, P("expected 1 to 48 of A-Z a-z 0-9 . _ -"));
}

/* errors and events ---------------------------------------------------------------------- */

static void record_error(enum code code, const char *why) {
  if (core.errors_count == ERRORS) {
    core.errors_count--;
    refuse(CODE_QUEUE_OVERFLOW, P(""));
    code = CODE_QUEUE_OVERFLOW;
    why = core.reason_data;
  }
  struct error *error = &core.errors[((uint16_t)core.errors_first + core.errors_count++) % ERRORS];
  error->code = (int16_t)code;
  struct text text;
  text_start(&text, error->reason, ERROR_BYTES);
  put_string(&text, why);
}

struct text *event_start(flash_text name) {
  put_flash(&core.event, name);
  put_char(&core.event, ' ');
  return &core.event;
}

void event_end(void) { put_char(&core.event, '\n'); }

static void start_frame(struct text *text, char mark, uint32_t number) {
  text_start(text, core.answer_data, LINE_BYTES + 1);
  put_char(text, mark);
  put_int(text, number);
  put_char(text, ':');
  put_hex(text, core.boot, 4, false);
  put_char(text, ' ');
}

static void seal(struct text *text, uint16_t from) {
  uint16_t crc = crc16(0xFFFFu, text->data + from, (uint16_t)(text->used - from));
  put_char(text, '*');
  put_hex(text, crc, 4, true);
}

static void send_sealed(struct text *text) {
  seal(text, 0);
  put_char(text, '\n');
  board_send(text->data, text->used);
}

static void start_event(struct text *text, flash_text name) {
  start_frame(text, '!', core.events++);
  put_flash(text, name);
}

static void send_events(void) {
  char *event = core.event_data;
  struct text text;
  for (char *rest; *event && (rest = cut(event, '\n')); event = rest) {
    start_event(&text, P(""));
    put_string(&text, event);
    send_sealed(&text);
  }
  text_start(&core.event, core.event_data, EVENT_BYTES);
}

/* lease ---------------------------------------------------------------------------------- */

static void renew_lease(void) {
  core.lease_end = core.armed ? core.now + 1000 * (us_t)core.lease_ms : NEVER;
}

static void disarm(void) {
  core.armed = false;
  core.lease_end = NEVER;
  box_go_dark();
}

/* power and time ------------------------------------------------------------------------- */

void core_power_up(us_t now, bool cold) {
  uint16_t before = core.boot;
  if (!cold) {
    core.now = now;
    box_advance();
    box_go_dark();
  }
  memset(&core, 0, sizeof core);
  core.now = core.powered_at = now;
  core.lease_ms = LEASE_DEFAULT_MS;
  core.lease_end = NEVER;
  text_start(&core.event, core.event_data, EVENT_BYTES);
  text_start(&core.reason, core.reason_data, ERROR_BYTES);
  core.stop_seen = board_stop_is_open();
  if (cold) box_build();
  do core.boot = board_random_epoch();
  while (core.boot == 0 || core.boot == before);
  box_reset(true);
  text_start(&core.event, core.event_data, EVENT_BYTES);
}

void core_announce(us_t now) {
  core.now = now;
  struct text text;
  text_start(&text, core.answer_data, LINE_BYTES + 1);
  put_flash(&text, P(BOX_MODEL " " BOX_FIRMWARE " ready\n"));
  board_send(text.data, text.used);
  start_event(&text, P("BOOT POWER"));
  send_sealed(&text);
}

us_t core_deadline(void) {
  us_t due = box_deadline();
  if (core.lease_end < due) due = core.lease_end;
  if (core.pending && box_pending_due() < due) due = box_pending_due();
  return due;
}

static void keep_and_send(const struct request *request, struct text *frame) {
  send_sealed(frame);
  struct kept_answer *kept = &core.kept[core.kept_next];
  core.kept_next = (uint8_t)((core.kept_next + 1u) % KEPT_ANSWERS);
  kept->request = *request;
  kept->size = frame->used; /* one that is longer than KEPT_BYTES is made again */
  if (frame->used <= KEPT_BYTES) memcpy(kept->data, frame->data, frame->used);
}

/* Make a reply frame of its payload, or of the refusal, and send it. */
static void start_reply(struct text *frame, uint32_t seq) {
  start_frame(frame, '=', seq);
  put_flash(frame, P("0 "));
}

static void finish_reply(struct text *frame, uint32_t seq, enum code code) {
  if (code != CODE_OK) {
    start_frame(frame, '=', seq);
    put_int(frame, code);
    put_char(frame, ' ');
    put_string(frame, core.reason_data);
  } else if (frame->data[frame->used - 1] == ' ') {
    frame->data[--frame->used] = '\0'; /* no payload, no space */
  }
}

/* Answer a request; one that is not new neither renews the lease nor takes a kept answer's place. */
static void answer(const struct request *request, struct text *frame, enum code code, bool is_new) {
  finish_reply(frame, request->seq, code);
  if (code != CODE_OK) record_error(code, core.reason_data);
  if (!is_new) {
    send_sealed(frame);
    return;
  }
  renew_lease();
  keep_and_send(request, frame);
}

void core_advance(us_t now) {
  us_t due;
  while ((due = core_deadline()) <= now) {
    if (due > core.now) core.now = due;
    box_advance();
    send_events();
    if (core.pending && due >= box_pending_due()) {
      struct text frame;
      core.pending = false;
      start_reply(&frame, core.under_way.seq);
      answer(&core.under_way, &frame, box_pending_outcome(&frame), true);
    }
    if (due >= core.lease_end) {
      disarm();
      core.tripped = true;
      struct text text;
      start_event(&text, P("WDOG:TRIP "));
      put_int(&text, core.lease_ms);
      send_sealed(&text);
    }
  }
  if (now > core.now) core.now = now;
  box_advance();
  send_events();
}

/* lines ---------------------------------------------------------------------------------- */

static const FLASH struct command *find_command(const char *name) {
  for (uint8_t k = 0; k < COMMAND_COUNT; k++)
    if (equals_word(name, COMMANDS[k].name)) return &COMMANDS[k];
  return NULL;
}

/* Return whether a command makes dark or safe, whoever sends it. */
static bool makes_safe(char *text) {
  char *arguments = cut(text, ' ');
  const FLASH struct command *command = find_command(text);
  bool safe = command && (command->needs & BARE ||
                          (*command->harmless &&
                           equals_word(arguments ? arguments : "", command->harmless)));
  if (arguments) arguments[-1] = ' ';
  return safe;
}

static enum code execute(char *text, struct text *payload, bool framed) {
  char *arguments = cut(text, ' ');
  if (!arguments) arguments = text + strlen(text);
  const FLASH struct command *command = find_command(text);
  if (!command) return refuse(CODE_UNDEFINED_HEADER, P(""));
  bool harmless = *command->harmless && equals_word(arguments, command->harmless);
  bool query = text[0] && text[strlen(text) - 1] == '?';
  if (!framed && !query && !(command->needs & BARE) && !harmless)
    return refuse(CODE_UNFRAMED, P(""));
  if (!*arguments != !*command->arguments) {
    refuse(CODE_SYNTAX, P("expected "));
    put_flash(&core.reason, command->name);
    if (*command->arguments) put_char(&core.reason, ' ');
    put_flash(&core.reason, command->arguments);
    return CODE_SYNTAX;
  }
  if (command->needs & ARMED && !core.armed && !harmless)
    return refuse(core.tripped ? CODE_WATCHDOG_TRIPPED : CODE_NOT_ARMED, P(""));
  return command->run(arguments, payload);
}

static bool is_space(char c) { return c == ' ' || (c >= 9 && c <= 13) || (c >= 28 && c <= 31); }

void core_handle_bare_line(char *line, uint16_t size) {
  while (size && is_space(line[size - 1])) size--;
  line[size] = '\0';
  while (size && is_space(*line)) line++, size--;
  for (uint16_t k = 0; k < size; k++)
    if (!line[k]) line[k] = 1;
  struct text payload;
  text_start(&payload, core.answer_data, LINE_BYTES + 1);
  enum code code = execute(line, &payload, false);
  if (code != CODE_OK) {
    record_error(code, core.reason_data);
  } else if (*line && line[strlen(line) - 1] == '?') {
    put_char(&payload, '\n');
    board_send(payload.data, payload.used);
  }
}

struct frame {
  char mark;
  uint16_t boot;
  uint32_t number;
  char *text;
};

/* Parse "0", or digits without a leading zero, up to the 32-bit limit; return what follows. */
static char *parse_counter(char *text, uint32_t *number) {
  uint64_t value = 0;
  uint8_t count = 0;
  for (; is_digit(text[count]) && count < 10; count++)
    value = 10u * value + (uint8_t)(text[count] - '0');
  if (count == 0 || value > 0xFFFFFFFFu || (text[0] == '0' && count > 1)) return NULL;
  *number = (uint32_t)value;
  return text + count;
}

static bool is_code_and_payload(const char *text) {
  uint8_t count = 0;
  bool negative = *text == '-';
  if (negative) text++;
  if (*text == '0') {
    if (negative) return false;
    text++;
  } else {
    for (; is_digit(*text); text++)
      if (++count > 4) return false;
    if (count == 0) return false;
  }
  return !*text || (*text == ' ' && text[1]);
}

static bool is_name_and_payload(const char *text) {
  uint8_t count = 0;
  for (; (*text >= 'A' && *text <= 'Z') || (count && (is_digit(*text) || *text == ':')); text++)
    if (++count > 32) return false;
  return count && (!*text || (*text == ' ' && text[1]));
}

static bool has_checksum(const char *line, uint16_t size) {
  if (size < 5 || line[size - 5] != '*') return false;
  for (uint16_t k = (uint16_t)(size - 4); k < size; k++)
    if (hex_digit(line[k]) > 15 || line[k] != upper(line[k])) return false;
  return true;
}

static bool decode(char *line, uint16_t size, struct frame *frame) {
  if (!has_checksum(line, size)) return false;
  for (uint16_t k = 0; k < size; k++)
    if (line[k] < ' ' || line[k] > '~') return false;
  uint32_t stated;
  parse_hex(line + size - 4, &stated);
  size = (uint16_t)(size - 5);
  line[size] = '\0';
  if (crc16(0xFFFFu, line, size) != stated) return false;
  frame->mark = line[0];
  char *rest = parse_counter(line + 1, &frame->number);
  if (!rest || *rest++ != ':') return false;
  frame->boot = 0;
  for (uint8_t k = 0; k < 4; k++, rest++) {
    uint8_t digit = hex_digit(*rest);
    if (digit > 15 || (*rest >= 'A' && *rest <= 'F')) return false;
    frame->boot = (uint16_t)(frame->boot << 4 | digit);
  }
  if (*rest++ != ' ') return false;
  frame->text = rest;
  if (frame->mark == '@') return *rest != '\0';
  if (frame->mark == '=') return is_code_and_payload(rest);
  return frame->mark == '!' && is_name_and_payload(rest);
}

static void send_refusal(uint32_t seq, enum code code) {
  struct text frame;
  refuse(code, P(""));
  start_reply(&frame, seq);
  finish_reply(&frame, seq, code);
  send_sealed(&frame);
}

static void refuse_reused(uint32_t seq) {
  send_refusal(seq, CODE_SEQ_REUSED);
  record_error(CODE_SEQ_REUSED, core.reason_data);
}

/* A host begins; an old hello again changes nothing. */
static void note_hello(uint32_t seq) {
  for (uint8_t k = 0; k < core.hellos_count; k++)
    if (core.hellos[k] == seq) return;
  core.hellos[core.hellos_next] = seq;
  core.hellos_next = (uint8_t)((core.hellos_next + 1u) % HELLOS);
  if (core.hellos_count < HELLOS) core.hellos_count++;
  core.latest_seq = seq;
  core.heard = true;
}

/* Return whether a request is not to be executed: it was answered, is being executed, or comes
   with a used number. What makes safe is executed whatever its number. */
static bool is_repeated(const struct request *request, bool *is_new, bool safe) {
  for (uint8_t k = 0; k <= KEPT_ANSWERS; k++) {
    bool last = k == KEPT_ANSWERS;
    if (last && !core.pending) break;
    const struct kept_answer *kept = &core.kept[((uint16_t)core.kept_next + k) % KEPT_ANSWERS];
    const struct request *before = last ? &core.under_way : &kept->request;
    if (before->length == 0 || before->seq != request->seq) continue;
    if (before->hash == request->hash && before->length == request->length) {
      if (last) { /* answered when it is complete; its host still waits */
        renew_lease();
        return true;
      }
      if (kept->size > KEPT_BYTES) return false;
      board_send(kept->data, kept->size);
      return true;
    }
    *is_new = false; /* the number of another request */
  }
  if (*is_new || safe) return false;
  refuse_reused(request->seq);
  return true;
}

void core_handle_framed_line(char *line, uint16_t size) {
  struct frame frame = {0};
  struct text reply;
  if (!decode(line, size, &frame)) {
    start_event(&reply, P("NAK 204"));
    send_sealed(&reply);
    return;
  }
  if (frame.mark != '@') return; /* the box's own output, returned by an echoing line */
  if (frame.boot == 0 && strcmp(frame.text, "SYST:HELLO?") == 0) {
    note_hello(frame.number);
    start_reply(&reply, frame.number);
    execute(frame.text, &reply, true);
    send_sealed(&reply);
    return;
  }
  if (frame.boot != core.boot) {
    send_refusal(frame.number, CODE_BOOT_CHANGED);
    return;
  }
  uint32_t ahead = frame.number - core.latest_seq; /* modulo 2^32 */
  bool behind = core.heard && ahead > 0x7FFFFFFFu;
  bool is_new = !behind && (ahead > 0 || !core.heard);
  if (is_new) {
    renew_lease();
    core.latest_seq = frame.number;
    core.heard = true;
  }
  struct request request = {frame.number, hash32(frame.text), (uint16_t)strlen(frame.text)};
  if (is_repeated(&request, &is_new, makes_safe(frame.text))) return;
  start_reply(&reply, request.seq);
  enum code code = execute(frame.text, &reply, true);
  if (code == CODE_PENDING) {
    core.under_way = request;
    core.pending = true;
    renew_lease();
    return;
  }
  answer(&request, &reply, code, is_new);
}

static void handle_line(char *line, uint16_t size) {
  if (line[size - 1] == '\r') size--;
  if (size == 0) return;
  line[size] = '\0';
  bool framed = line[0] == '@' || line[0] == '=' || line[0] == '!' || has_checksum(line, size);
  (framed ? core_handle_framed_line : core_handle_bare_line)(line, size);
  send_events();
}

void core_feed(const char *bytes, uint16_t size, us_t now) {
  core_advance(now);
  for (; size; size--, bytes++) {
    if (*bytes == '\n') {
      if (!core.discarding && core.line_used) handle_line(core.line, core.line_used);
      core.line_used = 0;
      core.discarding = false;
    } else if (!core.discarding) {
      core.line[core.line_used++] = *bytes;
      if (core.line_used == LINE_BYTES) {
        core.line_used = 0;
        core.discarding = true;
      }
    }
  }
}

/* commands of every box ------------------------------------------------------------------ */

#define COMMAND(name) enum code name(char *arguments, struct text *answer)
#define UNUSED (void)arguments, (void)answer

static void put_hello(struct text *text) {
  put_flash(text, P(BOX_PROTOCOL "," BOX_KIND "," BOX_SERIAL "," BOX_FIRMWARE));
}

static enum code put_number(struct text *answer, int64_t value) {
  put_int(answer, value);
  return CODE_OK;
}

COMMAND(get_idn) {
  UNUSED;
  put_flash(answer, P("RIGSIM," BOX_MODEL "," BOX_SERIAL "," BOX_FIRMWARE));
  return CODE_OK;
}

COMMAND(do_rst) {
  UNUSED;
  disarm();
  box_reset(false);
  return CODE_OK;
}

COMMAND(do_cls) {
  UNUSED;
  core.errors_count = 0;
  return CODE_OK;
}

COMMAND(get_opc) {
  UNUSED;
  return put_number(answer, !box_is_busy());
}

COMMAND(get_syst_err) {
  UNUSED;
  if (core.errors_count == 0) {
    put_flash(answer, P("0,\"No error\""));
    return CODE_OK;
  }
  struct error *error = &core.errors[core.errors_first];
  core.errors_first = (uint8_t)((core.errors_first + 1u) % ERRORS);
  core.errors_count--;
  put_int(answer, error->code);
  put_flash(answer, P(",\""));
  put_string(answer, error->reason);
  put_char(answer, '"');
  return CODE_OK;
}

COMMAND(get_syst_hello) {
  UNUSED;
  put_hello(answer);
  return CODE_OK;
}

COMMAND(get_syst_cap) {
  UNUSED;
  uint16_t from = answer->used;
  put_flash(answer, CAPABILITIES);
  seal(answer, from);
  return CODE_OK;
}

COMMAND(get_syst_cap_part) {
  uint16_t length = sizeof CAPABILITIES - 1 + 5; /* with its checksum */
  int64_t part, last = (length - 1) / CAPABILITY_CHUNK;
  enum code code = parse_number(arguments, 0, last * NANO, P("parts"), 9, &part);
  if (code) return code;
  part = floor_divide(part, NANO);
  put_int(answer, part == last);
  put_char(answer, ',');
  uint16_t crc = 0xFFFFu;
  char digits[8];
  struct text checksum;
  for (uint16_t k = 0; k < sizeof CAPABILITIES - 1; k++) {
    char letter = CAPABILITIES[k];
    crc = crc16(crc, &letter, 1);
  }
  text_start(&checksum, digits, sizeof digits);
  put_char(&checksum, '*');
  put_hex(&checksum, crc, 4, true);
  for (uint16_t k = 0; k < CAPABILITY_CHUNK; k++) {
    uint16_t at = (uint16_t)(part * CAPABILITY_CHUNK + k);
    if (at < length)
      put_char(answer, at < length - 5 ? CAPABILITIES[at] : digits[at - (length - 5)]);
  }
  return CODE_OK;
}

COMMAND(do_syst_wdog) {
  (void)answer;
  int64_t nano;
  enum code code =
      parse_number(arguments, LEASE_MIN_MS * NANO, LEASE_MAX_MS * NANO, P("ms"), 9, &nano);
  if (code) return code;
  core.lease_ms = (uint16_t)(nano / NANO);
  return CODE_OK;
}

COMMAND(get_syst_wdog) {
  UNUSED;
  return put_number(answer, core.lease_ms);
}

COMMAND(do_syst_arm) {
  UNUSED;
  core.armed = true;
  core.tripped = false;
  return CODE_OK;
}

COMMAND(get_syst_arm) {
  UNUSED;
  return put_number(answer, core.armed);
}

COMMAND(get_syst_ping) {
  UNUSED;
  return put_number(answer, core_clock_us());
}

COMMAND(do_safe) {
  UNUSED;
  disarm();
  return CODE_OK;
}

COMMAND(do_abor) { return do_safe(arguments, answer); }

COMMAND(get_stat) {
  UNUSED;
  uint16_t bits = (uint16_t)(core.armed | core.tripped << 1 | (core.errors_count > 0) << 2);
  bits |= (uint16_t)(board_stop_is_open() ? 256u : 0u);
  return put_number(answer, bits | box_status());
}
