// TCP and TLS below DIMSE: dimse_transport.h
#include "daemon/dicom/dimse_transport.h"

#include <dcmtk/dcmnet/dcmtrans.h>
#include <dcmtk/dcmtls/tlstrans.h>

#include <arpa/inet.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <new>
#include <openssl/ssl.h>
#include <openssl/x509v3.h>
#include <sys/socket.h>

namespace
{

// Many archives write a reply in two pieces, and the second one waits until the first is acknowledged, by the kernel 40
// ms later: for a series of 512 objects, 14 s. The kernel forgets this wish, which is told again at each reading.
void acknowledge(DcmNativeSocketType socket)
{
	const int one = 1;

	setsockopt(socket, IPPROTO_TCP, TCP_QUICKACK, &one, sizeof(one));
}

template <class Connection>
class Prompt : public Connection
{
      public:
	template <class... Rest>
	explicit Prompt(DcmNativeSocketType socket, Rest... rest) : Connection(socket, rest...)
	{
		const int one = 1;

		setsockopt(socket, IPPROTO_TCP, TCP_NODELAY, &one, sizeof(one));
		acknowledge(socket);
	}

	ssize_t read(void *bytes, size_t count) override
	{
		const ssize_t got = Connection::read(bytes, count);

		acknowledge(this->getSocket());
		return got;
	}

	OFBool networkDataAvailable(int timeout) override
	{
		acknowledge(this->getSocket());
		return Connection::networkDataAvailable(timeout);
	}
};

class SecureConnection : public Prompt<DcmTLSConnection>
{
      public:
	SecureConnection(DcmNativeSocketType socket, SSL *new_session, SecureLayer *of)
	    : Prompt<DcmTLSConnection>(socket, new_session), session(new_session), layer(of)
	{
	}

	OFCondition clientSideHandshake() override
	{
		const OFCondition condition = Prompt<DcmTLSConnection>::clientSideHandshake();
		const long found = SSL_get_verify_result(session);

		layer->refused =
		    condition.good() || found == X509_V_OK ? nullptr : X509_verify_cert_error_string(found);
		return condition;
	}

      private:
	SSL *session; // the connection's
	SecureLayer *layer;
};

int unfit(const char *what, const OFCondition &condition, struct error *err)
{
	return error_set(err, ERR_INVALID, "TLS: %s: %.120s", what, condition.text());
}

// The certificate names the host as the row does, by its name or its address.
bool expect_name(SSL_CTX *context, const char *host)
{
	X509_VERIFY_PARAM *wanted = SSL_CTX_get0_param(context);
	struct in_addr address;

	X509_VERIFY_PARAM_set_hostflags(wanted, X509_CHECK_FLAG_NO_PARTIAL_WILDCARDS);
	return (inet_pton(AF_INET, host, &address) == 1 ? X509_VERIFY_PARAM_set1_ip_asc(wanted, host)
							: X509_VERIFY_PARAM_set1_host(wanted, host, 0)) == 1;
}

} // namespace

DcmTransportConnection *PromptLayer::createConnection(DcmNativeSocketType socket, OFBool)
{
	return new (std::nothrow) Prompt<DcmTCPConnection>(socket);
}

int SecureLayer::prepare(const struct dimse_peer *peer, struct error *err)
{
	OFCondition condition = addTrustedCertificateFile(peer->authority, DCF_Filetype_PEM);

	if (condition.bad())
		return unfit("ca_file", condition, err);
	if (peer->certificate[0] != '\0') {
		// A key with a password would be asked for at a terminal that is not there.
		setPrivateKeyPasswd("");
		condition = setPrivateKeyFile(peer->key, DCF_Filetype_PEM);
		if (condition.bad())
			return unfit("key_file", condition, err);
		condition = setCertificateFile(peer->certificate, DCF_Filetype_PEM);
		if (condition.bad())
			return unfit("certificate_file", condition, err);
		if (!checkPrivateKeyMatchesCertificate())
			return error_set(err, ERR_INVALID, "TLS: the key is not the certificate's");
	}
	// Without downgrade: the plain profile would fall back to TLS 1.0.
	condition = setTLSProfile(TSP_Profile_BCP195_ND);
	if (condition.good())
		condition = activateCipherSuites();
	if (condition.bad())
		return unfit("the profile of BCP 195", condition, err);
	setCertificateVerification(DCV_requireCertificate);
	return expect_name(getNativeHandle(), peer->host) ? 0 : error_set(err, ERR_NO_MEMORY, "no memory for TLS");
}

DcmTransportConnection *SecureLayer::createConnection(DcmNativeSocketType socket, OFBool)
{
	SSL *session = SSL_new(getNativeHandle());

	if (session == nullptr)
		return nullptr;
	SSL_set_fd(session, (int)socket);
	return new (std::nothrow) SecureConnection(socket, session, this);
}
