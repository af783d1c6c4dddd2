#ifndef CBCT_CLIENTS_COMMANDS_H
#define CBCT_CLIENTS_COMMANDS_H

#include "clients/cbct/options.h"

/* One file for each; main.c has the table. */
extern const struct command command_simulate, command_upload, command_submit, command_watch, command_get, command_recon,
    command_import, command_export_geometry, command_compare, command_slice, command_scans, command_jobs,
    command_status, command_rm, command_complete, command_pin, command_unpin, command_limits, command_parameters,
    command_calibrate, command_token, command_audit, command_calibrate_scan, command_calibrations, command_doctor,
    command_backup, command_restore, command_reproduce, command_send, command_destinations, command_worklist,
    command_fit_hardening, command_fit_lag, command_fit_scatter, command_remote, command_refinement;

#endif
