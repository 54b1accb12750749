/* Limits of the flash box of rig 'flash'.
 * Made by tools/make_firmware_limits.py. */
#ifndef FIRMWARE_LIMITS_H
#define FIRMWARE_LIMITS_H

#include "core/text.h"

#define BOX_KIND "flash"
#define BOX_MODEL "FLASH2"
#ifndef BOX_SERIAL
#define BOX_SERIAL "FL-0001"
#endif
#define BOX_FIRMWARE "1.0"
#define BOX_PROTOCOL "1"
#define BOX_CAPABILITIES "{\"kind\":\"flash\",\"protocol\":1,\"protocol_minor\":3,\"lease_min_ms\":300,\"lease_max_ms\":5000,\"power_min\":0.00390625,\"power_max\":1.0,\"analyser_min_deg\":0.0,\"analyser_max_deg\":180.0,\"sync_min_us\":0.0,\"sync_max_us\":50000.0,\"led_min_nm\":420.0,\"led_max_nm\":680.0,\"lamp_min_ms\":1.0,\"lamp_max_ms\":500.0,\"recycle_s\":1.5,\"pops_per_min\":20,\"move_s_per_deg\":0.005556}"

#define RECYCLE_US 1500000
#define POPS_PER_MIN 20
#define QUARTER_TURN_US 500000
#define CHARGE_TAU_S 0.4434192973166191
#define INITIAL_HEAT 0.0

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
  X(do_flas_pol, "FLAS:POL", "PAR|CROS", 0, "") \
  X(get_flas_pol, "FLAS:POL?", "", 0, "") \
  X(do_flas_pol_ang, "FLAS:POL:ANG", "<deg>", 0, "") \
  X(get_flas_pol_ang, "FLAS:POL:ANG?", "", 0, "") \
  X(do_flas_pow, "FLAS:POW", "<share>", 0, "") \
  X(get_flas_pow, "FLAS:POW?", "", 0, "") \
  X(do_flas_sync, "FLAS:SYNC", "<us>", 0, "") \
  X(get_flas_sync, "FLAS:SYNC?", "", 0, "") \
  X(do_flas_led, "FLAS:LED", "<nm>,<nm>", 0, "") \
  X(get_flas_led, "FLAS:LED?", "", 0, "") \
  X(get_flas_char, "FLAS:CHAR?", "", 0, "") \
  X(do_flas_fire, "FLAS:FIRE", "<token>", ARMED, "") \
  X(get_flas_last, "FLAS:LAST?", "", 0, "") \
  X(get_flas_coun, "FLAS:COUN?", "", 0, "") \
  X(do_flas_lamp, "FLAS:LAMP", "ON,<ms>|OFF", ARMED, "") \
  X(get_flas_lamp, "FLAS:LAMP?", "", 0, "") \
  X(do_cam_trig, "CAM:TRIG", "<token>", 0, "")

#endif
