#ifndef CBCT_DAEMON_DICOM_DIMSE_TRANSPORT_H
#define CBCT_DAEMON_DICOM_DIMSE_TRANSPORT_H

#include <dcmtk/config/osconfig.h>

#include <dcmtk/dcmnet/dcmlayer.h>
#include <dcmtk/dcmtls/tlslayer.h>

#include "daemon/dicom/dimse.h"

// What associations to a peer go over: TCP, or TLS above it. For dimse_*.cc; one thread at a time.

// Without TLS. Outlives the connections that it makes, as the other one does.
class PromptLayer : public DcmTransportLayer
{
      public:
	DcmTransportConnection *createConnection(DcmNativeSocketType socket, OFBool) override;
};

// TLS 1.2 or newer with the suites of BCP 195; the peer's certificate is by our authority and names the peer's host.
class SecureLayer : public DcmTLSTransportLayer
{
      public:
	SecureLayer() : DcmTLSTransportLayer(NET_REQUESTOR, nullptr, OFTrue)
	{
	}
	// ERR_INVALID: a file of the peer's row is none, or certificate and key are not of one pair.
	int prepare(const struct dimse_peer *peer, struct error *err);
	DcmTransportConnection *createConnection(DcmNativeSocketType socket, OFBool secure) override;

	// Why the last peer's certificate was refused, a constant text; NULL: it was not.
	const char *refused = nullptr;
};

#endif
