/* Flicker at the eyes: flashes in the worst second, and the rms of 3 to 65 Hz. */
#include <math.h>
#include <string.h>

#include "boxes/led.h"

#define FUSION_S (1.0 / 65.0)
#define SAMPLE_S 2e-3
#define SECOND_SAMPLES 499 /* of a second, whose end is not in it */
#define MIN_FLASH_FRACTION 0.1
#define MIN_RMS_SPAN_S 2.0
#define TWO_PI 6.283185307179586
#define PART_SAMPLES 256 /* of one part of a judgment */
#define PART_ORDERS 128
#define PART_INTERVALS 32
#define PARTS_COUNT 3

/* Switching times with the change of light; then in s from now, with the light given until each. */
static struct {
  uint16_t count;
  bool full;
  us_t at[LIGHT_CHANGES];
  double step[LIGHT_CHANGES], time_s[LIGHT_CHANGES];
} change;

static void add_change(us_t at, double step) {
  uint16_t low = 0, high = change.count;
  while (low < high) {
    uint16_t middle = (uint16_t)((low + high) / 2);
    if (change.at[middle] < at)
      low = (uint16_t)(middle + 1);
    else
      high = middle;
  }
  if (low < change.count && change.at[low] == at) {
    change.step[low] += step;
    return;
  }
  if (change.count == LIGHT_CHANGES) {
    change.full = true;
    return;
  }
  for (uint16_t k = change.count++; k > low; k--) {
    change.at[k] = change.at[k - 1];
    change.step[k] = change.step[k - 1];
  }
  change.at[low] = at;
  change.step[low] = step;
}

static void add_pulse(const struct pulse *pulse, void *context) {
  (void)context;
  double step = LED_EYE_WEIGHT[pulse->led] * pulse->level;
  add_change(pulse->on, step);
  add_change(pulse->off, -step);
}

bool guard_is_full(void) { return change.full; }

/* The light given until a time, interpolated; `place` follows rising times. */
static double light_until(double at_s, uint16_t *place) {
  uint16_t last = (uint16_t)(change.count - 1);
  if (at_s <= change.time_s[0]) return change.step[0];
  if (at_s >= change.time_s[last]) return change.step[last];
  while (change.time_s[*place + 1] <= at_s) ++*place;
  double from = change.time_s[*place];
  double slope = (change.step[*place + 1] - change.step[*place]) /
                 (change.time_s[*place + 1] - from);
  return slope * (at_s - from) + change.step[*place];
}

/* The light that the eye perceives: averaged over the fusion time. */
static double seen(uint32_t sample, double start_s, uint16_t places[2]) {
  double at_s = start_s + sample * SAMPLE_S;
  double upper = light_until(at_s + 0.5 * FUSION_S, &places[0]);
  return (upper - light_until(at_s - 0.5 * FUSION_S, &places[1])) / FUSION_S;
}

/* Largest number of turns in any second, from the samples of the turns as they come. */
static struct {
  uint32_t at[SECOND_SAMPLES + 1];
  uint16_t first, count, most;
} turns;

static void add_turn(uint32_t sample) {
  while (turns.count && sample - turns.at[turns.first] > SECOND_SAMPLES) {
    turns.first = (uint16_t)((turns.first + 1) % (SECOND_SAMPLES + 1));
    turns.count--;
  }
  turns.at[(turns.first + turns.count++) % (SECOND_SAMPLES + 1)] = sample;
  if (turns.count > turns.most) turns.most = turns.count;
}

/* Samples of the light in one pass to find the brightest, and in another to find the turns. */
static struct {
  uint32_t next, count;
  uint16_t places[2];
  double start_s, most, low, high;
  int8_t direction;
} samples;

static void integrate(void) {
  double rate = 0.0, total = 0.0;
  for (uint16_t k = 0; k < change.count; k++) {
    change.time_s[k] = seconds_of(change.at[k] - core_now());
    if (k) total += rate * (change.time_s[k] - change.time_s[k - 1]);
    rate += change.step[k];
    change.step[k] = total;
  }
}

static void start_samples(void) {
  memset(&samples, 0, sizeof samples);
  turns.first = turns.count = turns.most = 0;
  if (change.count == 0) return;
  samples.start_s = change.time_s[0] - 0.1;
  double stop_s = change.time_s[change.count - 1] + 0.1;
  samples.count = (uint32_t)ceil((stop_s - samples.start_s) / SAMPLE_S);
}

/* The next sample; false at the end of a pass, which then starts again. */
static bool take_sample(double *value) {
  if (samples.next == samples.count) {
    samples.next = samples.places[0] = samples.places[1] = 0;
    return false;
  }
  *value = seen(samples.next++, samples.start_s, samples.places);
  return true;
}

static bool find_brightest(void) {
  double value;
  for (uint16_t k = 0; k < PART_SAMPLES; k++) {
    if (!take_sample(&value)) return true;
    if (value > samples.most) samples.most = value;
  }
  return false;
}

/* A flash is a rise and a fall by a tenth of the brightest light. */
static bool find_turns(void) {
  double value, least = MIN_FLASH_FRACTION * samples.most;
  for (uint16_t k = 0; k < PART_SAMPLES; k++) {
    if (samples.most <= 0.0 || !take_sample(&value)) return true;
    if (samples.next == 1) samples.low = samples.high = value;
    if (value < samples.low) samples.low = value;
    if (value > samples.high) samples.high = value;
    if (samples.direction <= 0 && value >= samples.low + least) {
      samples.direction = 1;
      samples.high = value;
      add_turn(samples.next - 1);
    } else if (samples.direction >= 0 && value <= samples.high - least) {
      samples.direction = -1;
      samples.low = value;
      add_turn(samples.next - 1);
    }
    if (samples.direction > 0) samples.low = samples.high;
    if (samples.direction < 0) samples.high = samples.low;
  }
  return false;
}

/* Intervals of light; LEDs that are lit together add up to one light at the eye. */
static struct {
  uint16_t count;
  us_t on[LIGHT_CHANGES], off[LIGHT_CHANGES];
  double light[LIGHT_CHANGES];
} interval;

static void add_interval(const struct pulse *pulse, void *context) {
  (void)context;
  if (pulse->off <= pulse->on) return;
  double light = LED_EYE_WEIGHT[pulse->led] * pulse->level;
  /* equal intervals come close to each other */
  for (uint16_t k = interval.count; k && k + 200 > interval.count; k--) {
    if (interval.on[k - 1] == pulse->on && interval.off[k - 1] == pulse->off) {
      interval.light[k - 1] += light;
      return;
    }
  }
  if (interval.count == LIGHT_CHANGES) {
    change.full = true;
    return;
  }
  interval.on[interval.count] = pulse->on;
  interval.off[interval.count] = pulse->off;
  interval.light[interval.count++] = light;
}

struct phasor {
  double real, imaginary;
};

/* The 3 to 65 Hz part, from first light to last: the sums of some orders of the span at a time. */
static struct {
  uint32_t order, last;
  uint16_t next; /* interval */
  us_t start;
  double span_s, mean, power;
  struct phasor sums[PART_ORDERS];
} band;

static void start_band(void) {
  memset(&band, 0, sizeof band);
  band.order = 1;
  if (interval.count == 0) return;
  us_t end = interval.off[0];
  band.start = interval.on[0];
  for (uint16_t k = 1; k < interval.count; k++) {
    band.start = sooner(band.start, interval.on[k]);
    end = later(end, interval.off[k]);
  }
  band.span_s = seconds_of(end - band.start);
  for (uint16_t k = 0; k < interval.count; k++)
    band.mean += interval.light[k] * seconds_of(interval.off[k] - interval.on[k]);
  band.mean /= band.span_s;
  if (band.span_s < MIN_RMS_SPAN_S || band.mean <= 0.0) return;
  band.order = (uint32_t)ceil(3.0 * band.span_s);
  band.last = (uint32_t)(65.0 * band.span_s);
}

static struct phasor phasor_of(double angle) { return (struct phasor){cos(angle), sin(angle)}; }

static void turn_phasor(struct phasor *phasor, const struct phasor *by) {
  double real = phasor->real * by->real - phasor->imaginary * by->imaginary;
  phasor->imaginary = phasor->real * by->imaginary + phasor->imaginary * by->real;
  phasor->real = real;
}

/* By Parseval the band's mean square is twice the sum of |c_n|^2 over positive orders; a pulse's
   coefficient is (exp(-i w off) - exp(-i w on)) / (-i w span). From one order to the next each
   phasor turns by the same angle. */
static bool add_orders(void) {
  if (band.order > band.last) return true;
  uint32_t count = band.last - band.order + 1;
  if (count > PART_ORDERS) count = PART_ORDERS;
  for (uint16_t k = 0; k < PART_INTERVALS && band.next < interval.count; k++, band.next++) {
    double rad_per_us = TWO_PI / (1e6 * band.span_s), light = interval.light[band.next];
    double on_angle = rad_per_us * (double)(interval.on[band.next] - band.start);
    double off_angle = rad_per_us * (double)(interval.off[band.next] - band.start);
    struct phasor on = phasor_of(band.order * on_angle), on_step = phasor_of(on_angle);
    struct phasor off = phasor_of(band.order * off_angle), off_step = phasor_of(off_angle);
    for (uint32_t n = 0; n < count; n++) {
      band.sums[n].real += light * (off.real - on.real);
      band.sums[n].imaginary += light * (off.imaginary - on.imaginary);
      turn_phasor(&on, &on_step);
      turn_phasor(&off, &off_step);
    }
  }
  if (band.next < interval.count) return false;
  for (uint32_t n = 0; n < count; n++) {
    double real = band.sums[n].real, imaginary = band.sums[n].imaginary;
    double size = TWO_PI * (band.order + n);
    band.power += (real * real + imaginary * imaginary) / (size * size);
  }
  memset(band.sums, 0, sizeof band.sums);
  band.order += count;
  band.next = 0;
  return false;
}

/* all ------------------------------------------------------------------------------------- */

static bool (*const PARTS[PARTS_COUNT])(void) = {find_brightest, find_turns, add_orders};
static uint8_t part;

void guard_start(requested_light *past, requested_light *light) {
  change.count = interval.count = part = 0;
  change.full = false;
  past(-1, add_pulse, NULL);
  light(-1, add_pulse, NULL);
  light(-1, add_interval, NULL);
  if (change.full) part = PARTS_COUNT;
  integrate();
  start_samples();
  start_band();
}

bool guard_continue(void) {
  bank_keep_ends();
  if (part < PARTS_COUNT && PARTS[part]()) part++;
  return part < PARTS_COUNT;
}

double guard_flashes_per_s(void) { return turns.most / 2.0; }

double guard_rms(void) { return band.power > 0.0 ? sqrt(2.0 * band.power) / band.mean : 0.0; }
