/* Limits of the dome box of rig 'dome'.
 * Made by tools/make_firmware_limits.py. */
#ifndef FIRMWARE_LIMITS_H
#define FIRMWARE_LIMITS_H

#include "core/text.h"

#define BOX_KIND "dome"
#define BOX_MODEL "DOME1"
#ifndef BOX_SERIAL
#define BOX_SERIAL "DM-0001"
#endif
#define BOX_FIRMWARE "1.0"
#define BOX_PROTOCOL "1"
#define BOX_CAPABILITIES "{\"kind\":\"dome\",\"protocol\":1,\"protocol_minor\":3,\"lease_min_ms\":300,\"lease_max_ms\":5000,\"leds\":150,\"cameras\":16,\"max_rows\":1024,\"row_min_us\":2000,\"row_max_us\":500000,\"level_steps\":1000,\"max_at_once\":24,\"led_max_ms\":500.0,\"max_duty\":0.25,\"duty_window_s\":1.0,\"thermal_tau_s\":4.0,\"thermal_trip\":0.6,\"dose_ws\":50.0,\"max_flashes_per_s\":3.0,\"max_flicker_rms\":0.25,\"overlap_us\":100,\"settle_us\":1000}"

#define LEDS 150
#define CAMERAS 16
#define MAX_ROWS 1024
#define MAX_AT_ONCE 24
#define ROW_MAX_US 500000
#define LED_MAX_US 500000
#define MAX_DUTY 0.25
#define DUTY_WINDOW_US 1000000
#define THERMAL_TAU_S 4.0
#define THERMAL_TRIP 0.6
#define DOSE_NANO_WS 50000000000
#define DOSE_WS 50.0
#define MAX_FLASHES_PER_S 3.0
#define MAX_FLICKER_RMS 0.25
#define OVERLAP_US 100
#define SETTLE_US 1000
#define INITIAL_HEAT 0.0
static const FLASH double LED_POWER_W[] = {1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0};
static const FLASH double LED_EYE_WEIGHT[] = {0.0, 0.0, 0.0, 0.0, 0.2051595318919123, 0.2051595318919123, 0.0, 0.0, 0.19850591243638935, 0.19850591243638935, 0.0, 0.0, 0.6262862734688336, 0.0, 0.0, 0.0, 0.577395498155695, 0.577395498155695, 0.0, 0.0, 0.05956485116168424, 0.05956485116168424, 0.0, 0.0, 0.9480874396337192, 0.9480874396337192, 0.0, 0.0, 0.4438975108892806, 0.4438975108892806, 0.0, 0.0, 0.905978049814589, 0.905978049814589, 0.0, 0.0, 1.2426492828587354, 0.0, 0.0, 0.0, 0.258890846466335, 0.258890846466335, 0.0, 0.0, 1.2529432821542037, 1.2529432821542037, 0.0, 0.0, 0.6990869072241529, 0.6990869072241529, 0.0, 0.0, 1.1135815005913445, 1.1135815005913445, 0.0, 1.4529823137019038, 0.0, 0.0, 0.05891776128431706, 0.05891776128431706, 0.0, 0.0, 0.4332819362362741, 0.4332819362362741, 0.0, 0.0, 1.403490329047398, 1.403490329047398, 0.0, 0.0, 0.8642323951502112, 0.8642323951502112, 0.0, 0.0, 0.0, 0.0, 0.0, 0.19655293817124264, 0.5601458680719028, 1.1509948926278508, 1.4840808171211508, 1.1509948926278508, 0.5601458680719028, 0.19655293817124264, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.828123870164574, 0.828123870164574, 0.0, 0.0, 1.3381231193035632, 1.3381231193035632, 0.0, 0.0, 0.4069033278346887, 0.4069033278346887, 0.0, 0.0, 0.05560473041949182, 0.05560473041949182, 0.0, 1.3404827634909375, 0.0, 0.0, 1.021994339839272, 1.021994339839272, 0.0, 0.0, 0.6270572498142875, 0.6270572498142875, 0.0, 0.0, 1.1078425691999523, 1.1078425691999523, 0.0, 0.0, 0.23058909115685686, 0.23058909115685686, 0.0, 0.0, 1.0711811799244866, 0.0, 0.0, 0.0, 0.7750628160332067, 0.7750628160332067, 0.0, 0.0, 0.37596551360842057, 0.37596551360842057, 0.0, 0.0, 0.7877429189285892, 0.7877429189285892, 0.0, 0.0, 0.05102926289517056, 0.05102926289517056, 0.0, 0.0, 0.4724275114711496, 0.4724275114711496, 0.0, 0.0, 0.5061476371432426, 0.0};

/* X(handler, header, arguments, needs, arguments that make dark) */
#define BOX_COMMANDS(X) \
  X(get_idn, "*IDN?", "", 0, "") \
  X(do_rst, "*RST", "", 0, "") \
  X(do_cls, "*CLS", "", BARE, "") \
  X(get_opc, "*OPC?", "", 0, "") \
  X(get_syst_err, "SYST:ERR?", "", 0, "") \
  X(get_syst_hello, "SYST:HELLO?", "", 0, "") \
  X(get_syst_cap, "SYST:CAP?", "", 0, "") \
  X(get_syst_cap_part, "SYST:CAP:PART?", "<n>", 0, "") \
  X(do_syst_wdog, "SYST:WDOG", "<ms>", 0, "") \
  X(get_syst_wdog, "SYST:WDOG?", "", 0, "") \
  X(do_syst_arm, "SYST:ARM", "", 0, "") \
  X(get_syst_arm, "SYST:ARM?", "", 0, "") \
  X(get_syst_ping, "SYST:PING?", "", 0, "") \
  X(do_safe, "SAFE", "", BARE, "") \
  X(do_abor, "ABOR", "", BARE, "") \
  X(get_stat, "STAT?", "", 0, "") \
  X(do_seq_cle, "SEQ:CLE", "", 0, "") \
  X(get_seq_crc, "SEQ:CRC?", "", 0, "") \
  X(do_seq_arm, "SEQ:ARM", "<rows>", ARMED, "") \
  X(do_trig, "TRIG", "<token>", ARMED, "") \
  X(get_seq_pos, "SEQ:POS?", "", 0, "") \
  X(get_seq_step, "SEQ:STEP?", "<row>", 0, "") \
  X(do_cam_mask, "CAM:MASK", "<hex>", 0, "") \
  X(get_cam_mask, "CAM:MASK?", "", 0, "") \
  X(do_cam_trig, "CAM:TRIG", "<token>", 0, "") \
  X(do_safe_eyes, "SAFE:EYES", "OPEN|CLOSED|SHIELDED", 0, "") \
  X(get_safe_eyes, "SAFE:EYES?", "", 0, "") \
  X(get_led_fail, "LED:FAIL?", "", 0, "") \
  X(get_dose, "DOSE?", "<led>", 0, "") \
  X(do_dose_new, "DOSE:NEW", "<token>", 0, "") \
  X(do_seq_def, "SEQ:DEF", "<first>,<leds>:<level>:<us>:<mask>;...", 0, "") \
  X(do_led_on, "LED:ON", "<leds>[,<ms>[,<level>]]", ARMED, "") \
  X(do_led_off, "LED:OFF", "<leds>|ALL", 0, "") \
  X(get_led, "LED?", "", 0, "")

#endif
