#ifndef CBCT_DAEMON_DICOM_DIMSE_PROMISE_H
#define CBCT_DAEMON_DICOM_DIMSE_PROMISE_H

// Shared by the dimse_*.cc.

#include "daemon/dicom/dimse.h"

class DcmDataset;

// What an N-EVENT-REPORT of storage commitment says (PS3.4 J.3.3); false: it names no request.
bool promise_read(DcmDataset *answer, struct dimse_promise *ret_promise);

#endif
