/* The board `mega2560`: ATmega2560 at 16 MHz, as on the Arduino Mega. Flash, caliper and probe.
 *
 * Pins (port, Arduino number): see PIN_... below; docs/how-to/build-hardware.md has the table.
 * Timer 1 is the clock, timer 3 the steppers, timer 4 the analog levels; USART 0 is the line.
 */
#include "boards/board.h"

#include <avr/eeprom.h>
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/wdt.h>
#include <math.h>
#include <util/delay.h>

/* PORTA: outputs of lights, cameras and valves */
#define PIN_CAMERA 0    /* PA0, D22: camera line, pulse */
#define PIN_POP 1       /* PA1, D23: trigger of the flash tubes, pulse */
#define PIN_POP_LED 2   /* PA2, D24: trigger of the heads' LED, pulse */
#define PIN_LIGHT 3     /* PA3, D25: modeling lamps, or the probe's LED */
#define PIN_SHUTTER 4   /* PA4, D26: shutter's solenoid, high is open */
#define PIN_PUMP 5      /* PA5, D27: pump, high is on */
#define PIN_VENT 6      /* PA6, D28: vent valve, low is open */
#define PIN_HOLD 7      /* PA7, D29: clamps of the jaws, high is held */
/* PORTC: steppers */
#define PIN_STEP 0      /* PC0, D37: step of the analyzer, ring or cover */
#define PIN_DIRECTION 1 /* PC1, D36 */
#define PIN_JAW_STEP 2  /* PC2, D35: step of the jaws */
#define PIN_JAW_DIRECTION 3 /* PC3, D34 */
/* PORTL: inputs with pull-ups */
#define PIN_STOP 0      /* PL0, D49: emergency stop, low is closed */
#define PIN_LIGHT_FAULT 1 /* PL1, D48: low reports a missing current */
#define PIN_POP_FAULT 2 /* PL2, D47: low reports a missing ignition */
#define PIN_HOME 3      /* PL3, D46: home mark, low is seen */
#define PIN_BLADES_OPEN 4 /* PL4, D45: blades' sensor, low is open */
/* analog: A0 force, A1 gauge, A2 temperature, A3 jaws' distance; level: OC4A (PH3, D6), suction OC4B (PH4, D7) */

#define PULSE_US 100
#define STEPS_PER_S 2000
#define DRIVER_US 2 /* set-up of a direction, and length of a step */
#define MDEG_PER_STEP 225
#define MM_PER_STEP 0.0025
#define STALL_MM 0.05
#define RING 128 /* bytes received and not read */
#define OUT 1032 /* bytes to be sent: the longest answer, so that sending never waits */

#define MM_PER_READING 0.02 /* the jaws' potentiometer: 20.48 mm over 1024 readings */
#define UNPOWERED __attribute__((section(".noinit")))
#define KEPT_MARK 0x5AFE2560u

static volatile uint32_t overflows UNPOWERED;
static uint32_t kept_mark UNPOWERED; /* the memory holds what it held before the reset */
static uint8_t reset_cause UNPOWERED;
static volatile uint8_t in_head, in_tail;
static volatile uint16_t out_head, out_tail;
static volatile char in_ring[RING], out_ring[OUT];
static volatile int32_t stage_at, stage_target, jaws_at, jaws_target;
static double jaws_ordered_mm;

static uint16_t read_analog(uint8_t channel) {
  ADMUX = (uint8_t)(1u << REFS0 | channel);
  ADCSRA |= 1u << ADSC;
  while (ADCSRA & 1u << ADSC) {
  }
  return ADC;
}

static double jaws_reading_mm(void) { return read_analog(3) * MM_PER_READING; }

static void set_pin(volatile uint8_t *port, uint8_t pin, bool high) {
  uint8_t before = SREG;
  cli();
  *port = (uint8_t)(high ? *port | 1u << pin : *port & ~(1u << pin));
  SREG = before;
}

static void pulse(uint8_t pin) {
  set_pin(&PORTA, pin, true);
  _delay_us(PULSE_US);
  set_pin(&PORTA, pin, false);
}

static bool is_high(uint8_t pin) { return (PINL >> pin & 1) != 0; }

/* Before memory is set up: dark, vented and free; after a watchdog's reset it runs on with 16 ms. */
__attribute__((naked, used, section(".init3"))) void board_go_dark(void);
void board_go_dark(void) {
  PORTA = 0;
  DDRA = 0xFF;
  reset_cause = MCUSR;
  MCUSR = 0;
  wdt_enable(WDTO_120MS);
}

bool board_start(void) {
  /* a boot loader may have cleared the cause: then the mark decides */
  bool cold = (reset_cause & (1u << PORF | 1u << BORF)) != 0 || kept_mark != KEPT_MARK;
  kept_mark = 0;
  DDRC = 1u << PIN_STEP | 1u << PIN_DIRECTION | 1u << PIN_JAW_STEP | 1u << PIN_JAW_DIRECTION;
  PORTL = 0xFF;
  DDRH = 1u << 3 | 1u << 4;
  overflows = cold ? 0 : overflows + 1u; /* the timer begins at zero: never backwards */
  TCCR1B = 1u << CS11; /* 2 MHz */
  TIMSK1 = 1u << TOIE1;
  OCR3A = (uint16_t)(F_CPU / 8u / STEPS_PER_S - 1u);
  TCCR3B = 1u << WGM32 | 1u << CS31;
  TIMSK3 = 1u << OCIE3A;
  TCCR4A = 1u << COM4A1 | 1u << COM4B1 | 1u << WGM40;
  TCCR4B = 1u << WGM42 | 1u << CS40;
  ADMUX = 1u << REFS0;
  ADCSRA = 1u << ADEN | 1u << ADPS2 | 1u << ADPS1 | 1u << ADPS0;
  UCSR0A = 1u << U2X0;
  UBRR0 = 16; /* 115 200 Bd within 2.1 % */
  UCSR0B = 1u << RXEN0 | 1u << TXEN0 | 1u << RXCIE0;
  jaws_at = jaws_target = (int32_t)(jaws_reading_mm() / MM_PER_STEP + 0.5);
  sei();
  return cold;
}

ISR(TIMER1_OVF_vect) { overflows++; }

int64_t board_now_us(void) {
  uint8_t before = SREG;
  cli();
  uint16_t ticks = TCNT1;
  uint32_t high = overflows;
  if (TIFR1 & 1u << TOV1 && ticks < 0x8000u) high++;
  SREG = before;
  return ((int64_t)high << 16 | ticks) >> 1;
}

static void step_towards(volatile int32_t *at, int32_t target, uint8_t step, uint8_t direction) {
  if (*at == target) return;
  bool up = target > *at;
  set_pin(&PORTC, direction, up);
  _delay_us(DRIVER_US);
  set_pin(&PORTC, step, true);
  *at += up ? 1 : -1;
  _delay_us(DRIVER_US);
  set_pin(&PORTC, step, false);
}

ISR(TIMER3_COMPA_vect) {
  step_towards(&stage_at, stage_target, PIN_STEP, PIN_DIRECTION);
  step_towards(&jaws_at, jaws_target, PIN_JAW_STEP, PIN_JAW_DIRECTION);
}

/* line ------------------------------------------------------------------------------------ */

ISR(USART0_RX_vect) {
  char byte = (char)UDR0;
  uint8_t next = (uint8_t)((in_head + 1u) % RING);
  if (next == in_tail) return; /* lost: the frame's checksum will say so */
  in_ring[in_head] = byte;
  in_head = next;
}

static uint16_t sent_until(void) {
  uint8_t before = SREG;
  cli();
  uint16_t tail = out_tail;
  SREG = before;
  return tail;
}

/* No byte is taken while an answer might have to wait: a lamp's end must not wait with it. */
bool board_read(char *byte) {
  uint16_t waiting = (uint16_t)((out_head + OUT - sent_until()) % OUT);
  if (in_tail == in_head || waiting > OUT / 4u) return false;
  *byte = in_ring[in_tail];
  in_tail = (uint8_t)((in_tail + 1u) % RING);
  return true;
}

ISR(USART0_UDRE_vect) {
  if (out_tail == out_head) {
    UCSR0B = (uint8_t)(UCSR0B & ~(1u << UDRIE0));
    return;
  }
  UDR0 = (uint8_t)out_ring[out_tail];
  out_tail = (uint16_t)((out_tail + 1u) % OUT);
}

void board_send(const char *data, uint16_t size) {
  for (; size; size--, data++) {
    uint16_t next = (uint16_t)((out_head + 1u) % OUT);
    while (next == sent_until()) wdt_reset(); /* a longer answer waits for its beginning */
    out_ring[out_head] = *data;
    cli();
    out_head = next;
    UCSR0B |= 1u << UDRIE0;
    sei();
  }
}

/* A counter through a permutation: no epoch comes again in 65 536 starts. */
uint16_t board_random_epoch(void) {
  uint16_t *place = (uint16_t *)0;
  uint16_t count = (uint16_t)(eeprom_read_word(place) + 1u);
  eeprom_update_word(place, count);
  return (uint16_t)(count * 40503u + 0x9E37u);
}

void board_feed_watchdog(void) {
  kept_mark = KEPT_MARK;
  wdt_reset();
}

bool board_stop_is_open(void) { return is_high(PIN_STOP); }

/* lights and cameras ---------------------------------------------------------------------- */

void board_release_cameras(uint32_t mask) {
  if (mask) pulse(PIN_CAMERA);
}

bool board_set_led(uint16_t led, double level) {
  (void)led;
  if (level < 0.0) return is_high(PIN_LIGHT_FAULT);
  OCR4A = (uint8_t)(255.0 * level);
  set_pin(&PORTA, PIN_LIGHT, level > 0.0);
  return level <= 0.0 || is_high(PIN_LIGHT_FAULT);
}

bool board_pop(double power, uint16_t center_nm, uint16_t width_nm) {
  (void)width_nm;
  OCR4A = (uint8_t)(255.0 * power);
  pulse(center_nm ? PIN_POP_LED : PIN_POP);
  return is_high(PIN_POP_FAULT);
}

void board_turn(int32_t position) {
  int32_t target = position < 0 ? 0 : position / MDEG_PER_STEP;
  cli();
  stage_target = target;
  sei();
}

/* caliper --------------------------------------------------------------------------------- */

static int32_t jaw_steps(void) {
  cli();
  int32_t at = jaws_at;
  sei();
  return at;
}

/* The steps count from the potentiometer where they were lost, at power-up or in a stall. */
void board_start_jaws(double target_mm, bool back) {
  (void)target_mm, (void)back;
  double reading_mm = jaws_reading_mm();
  jaws_ordered_mm = (double)jaw_steps() * MM_PER_STEP;
  if (fabs(reading_mm - jaws_ordered_mm) <= STALL_MM) return;
  int32_t at = (int32_t)(reading_mm / MM_PER_STEP + 0.5);
  cli();
  jaws_at = jaws_target = at;
  sei();
  jaws_ordered_mm = (double)at * MM_PER_STEP;
}

bool board_drive_jaws(double distance_mm) {
  int32_t target = (int32_t)(distance_mm / MM_PER_STEP + 0.5);
  cli();
  jaws_target = target;
  sei();
  jaws_ordered_mm = distance_mm;
  return !is_high(PIN_HOME);
}

void board_read_jaws(double *distance_mm, double *force_n) {
  double steps_mm = (double)jaw_steps() * MM_PER_STEP, reading_mm = jaws_reading_mm();
  bool stalled = fabs(reading_mm - steps_mm) > STALL_MM;
  bool follows = fabs(jaws_ordered_mm - steps_mm) <= STALL_MM; /* within the stepper's delay */
  *distance_mm = stalled ? reading_mm : follows ? jaws_ordered_mm : steps_mm;
  *force_n = (read_analog(0) - 512.0) * (10.0 / 512.0); /* amplifier: -10 to 10 N */
}

void board_hold_skin(bool hold) { set_pin(&PORTA, PIN_HOLD, hold); }

/* probe ----------------------------------------------------------------------------------- */

void board_move_shutter(bool open) { set_pin(&PORTA, PIN_SHUTTER, open); }
bool board_shutter_is(bool open) { return is_high(PIN_BLADES_OPEN) != open; }

void board_set_suction(double mbar) {
  OCR4B = (uint8_t)(mbar); /* regulator: 0 to 255 mbar */
  set_pin(&PORTA, PIN_VENT, mbar > 0.0);
  set_pin(&PORTA, PIN_PUMP, mbar > 0.0);
}

bool board_gauge_mbar(double *mbar) {
  uint16_t reading = read_analog(1); /* 0.5 to 4.5 V for 0 to 250 mbar */
  *mbar = (reading - 102.0) * (250.0 / 819.0);
  return reading > 40; /* below that the gauge draws no current */
}

double board_camera_c(void) { return read_analog(2) * (500.0 / 1024.0) - 50.0; /* TMP36 */ }
