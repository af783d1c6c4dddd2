/*
 * TLS: the certificate that the library shows, and those that clients show.
 *
 * libmicrohttpd speaks TLS through GnuTLS. It asks for the certificate at each
 * handshake, so that one that was read again at SIGHUP serves the next
 * connection while those that are there go on. A client's certificate is
 * verified here, once for each connection: the library only asks for it.
 *
 * Ciphers: TLS 1.2 and 1.3 with forward secrecy and authenticated encryption,
 * which is all that a client of the last ten years needs. AES-128 goes first:
 * nobody breaks it, and it is a quarter faster than AES-256.
 *
 * The gate (http/gate.c) looks at bytes that GnuTLS has decrypted.
 */
#include "daemon/http/internal.h"

#include <dlfcn.h>
#include <errno.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <time.h>

#include <gnutls/abstract.h>
#include <gnutls/x509.h>

#include "daemon/lock.h"
#include "daemon/log.h"
#include "proto/scan_directory.h"

enum { CHAIN_MAX = 16, PEM_BYTES_MAX = 1 << 20 };

const char tls_priorities[] = "NORMAL:-VERS-ALL:+VERS-TLS1.3:+VERS-TLS1.2:-KX-ALL:+ECDHE-ECDSA:+ECDHE-RSA:-CIPHER-ALL:"
			      "+AES-128-GCM:+AES-256-GCM:+CHACHA20-POLY1305:-SIGN-RSA-SHA1:-SIGN-ECDSA-SHA1:"
			      "%SERVER_PRECEDENCE";

/* Credentials as they were read from the files; constant. */
struct credentials {
	gnutls_pcert_st chain[CHAIN_MAX];
	unsigned chain_length;
	gnutls_privkey_t key;
	gnutls_x509_trust_list_t clients; /* NULL: no certificate is asked for */
	double retired;                   /* clock_monotonic, when others took its place */
	struct credentials *older;
};

struct tls {
	const char *certificate, *key, *client_authorities; /* paths */
	char *trust;                                        /* PEM, for the library */
	double handshake_seconds;                           /* that a handshake takes at most */
	pthread_mutex_t lock;
	struct credentials *credentials; /* guarded by lock; those that were retired behind them */
};

static int tls_error(struct error *err, const char *path, int code)
{
	return error_set(err, ERR_INVALID, "%s: %s", path, gnutls_strerror(code));
}

/* ---- credentials ---- */

static void credentials_free(struct credentials *credentials)
{
	while (credentials != NULL) {
		struct credentials *older = credentials->older;

		for (unsigned i = 0; i < credentials->chain_length; i++)
			gnutls_pcert_deinit(&credentials->chain[i]);
		gnutls_privkey_deinit(credentials->key);
		if (credentials->clients != NULL)
			gnutls_x509_trust_list_deinit(credentials->clients, 1);
		free(credentials);
		credentials = older;
	}
}

static int read_pem(const char *path, char **ret_text, gnutls_datum_t *ret, struct error *err)
{
	size_t length;

	if (file_read(path, PEM_BYTES_MAX, ret_text, &length, err) != 0)
		return err->code;
	*ret = (gnutls_datum_t){(unsigned char *)*ret_text, (unsigned)length};
	return 0;
}

static int read_chain(const char *path, struct credentials *credentials, struct error *err)
{
	gnutls_datum_t pem;
	char *text;
	int code;

	if (read_pem(path, &text, &pem, err) != 0)
		return err->code;
	credentials->chain_length = CHAIN_MAX;
	code = gnutls_pcert_list_import_x509_raw(credentials->chain, &credentials->chain_length, &pem,
						 GNUTLS_X509_FMT_PEM, GNUTLS_X509_CRT_LIST_SORT);
	free(text);
	if (code < 0)
		credentials->chain_length = 0;
	return code < 0 ? tls_error(err, path, code) : 0;
}

static int read_key(const char *path, struct credentials *credentials, struct error *err)
{
	struct stat status;
	gnutls_datum_t pem;
	char *text;
	int code;

	if (stat(path, &status) != 0)
		return error_set_errno(err, errno, "%s", path);
	if (file_is_guarded(path, &status, err) != 0 || read_pem(path, &text, &pem, err) != 0)
		return err->code;
	code = gnutls_privkey_import_x509_raw(credentials->key, &pem, GNUTLS_X509_FMT_PEM, NULL, 0);
	explicit_bzero(text, pem.size);
	free(text);
	return code < 0 ? tls_error(err, path, code) : 0;
}

/* A new certificate with the old key, or the other way round, would fail in each handshake. */
static int check_pair(const struct tls *tls, const struct credentials *credentials, struct error *err)
{
	unsigned char of_key[64], of_certificate[64];
	size_t key_size = sizeof(of_key), certificate_size = sizeof(of_certificate);
	gnutls_pubkey_t public;
	int code = gnutls_pubkey_init(&public);

	if (code < 0)
		return tls_error(err, tls->key, code);
	code = gnutls_pubkey_import_privkey(public, credentials->key, 0, 0);
	if (code == 0)
		code = gnutls_pubkey_get_key_id(public, 0, of_key, &key_size);
	if (code == 0)
		code = gnutls_pubkey_get_key_id(credentials->chain[0].pubkey, 0, of_certificate, &certificate_size);
	gnutls_pubkey_deinit(public);
	if (code < 0)
		return tls_error(err, tls->key, code);
	if (key_size != certificate_size || memcmp(of_key, of_certificate, key_size) != 0)
		return error_set(err, ERR_INVALID, "%s is not the key of the certificate in %s", tls->key,
				 tls->certificate);
	return 0;
}

static int read_authorities(const char *path, struct credentials *credentials, struct error *err)
{
	gnutls_datum_t pem;
	char *text;
	int count;

	if (path[0] == '\0')
		return 0;
	if (read_pem(path, &text, &pem, err) != 0)
		return err->code;
	count = gnutls_x509_trust_list_init(&credentials->clients, 0);
	if (count == 0)
		count =
		    gnutls_x509_trust_list_add_trust_mem(credentials->clients, &pem, NULL, GNUTLS_X509_FMT_PEM, 0, 0);
	free(text);
	if (count < 0)
		return tls_error(err, path, count);
	return count > 0 ? 0 : error_set(err, ERR_INVALID, "%s has no certificate", path);
}

static int credentials_read(const struct tls *tls, struct credentials **ret, struct error *err)
{
	struct credentials *credentials = calloc(1, sizeof(*credentials));

	if (credentials == NULL || gnutls_privkey_init(&credentials->key) < 0) {
		free(credentials);
		return error_set(err, ERR_NO_MEMORY, "no memory for a certificate");
	}
	if (read_chain(tls->certificate, credentials, err) != 0 || read_key(tls->key, credentials, err) != 0 ||
	    check_pair(tls, credentials, err) != 0 ||
	    read_authorities(tls->client_authorities, credentials, err) != 0) {
		credentials_free(credentials);
		return err->code;
	}
	*ret = credentials;
	return 0;
}

/* ---- life ---- */

int tls_new(const struct http_options *options, struct tls **ret_tls, struct error *err)
{
	struct tls *tls;
	size_t length;

	if (options->tls_certificate[0] == '\0' && options->tls_key[0] == '\0' &&
	    options->tls_client_authorities[0] == '\0')
		return 0;
	if (options->tls_certificate[0] == '\0' || options->tls_key[0] == '\0')
		return error_set(err, ERR_INVALID, "TLS needs both --tls-cert and --tls-key");
	tls = calloc(1, sizeof(*tls));
	if (tls == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for TLS");
	lock_init(&tls->lock, LOCK_TLS);
	tls->certificate = options->tls_certificate;
	tls->key = options->tls_key;
	tls->client_authorities = options->tls_client_authorities;
	tls->handshake_seconds = options->header_timeout;
	if (credentials_read(tls, &tls->credentials, err) != 0 ||
	    (tls->client_authorities[0] != '\0' &&
	     file_read(tls->client_authorities, PEM_BYTES_MAX, &tls->trust, &length, err) != 0)) {
		tls_free(tls);
		return err->code;
	}
	*ret_tls = tls;
	return 0;
}

void tls_free(struct tls *tls)
{
	if (tls == NULL)
		return;
	credentials_free(tls->credentials);
	free(tls->trust);
	pthread_mutex_destroy(&tls->lock);
	free(tls);
}

/* Credentials that no handshake uses any more: the clock ends those that take longer. With the lock held. */
static struct credentials *take_unused(struct tls *tls, double now)
{
	struct credentials **next = &tls->credentials->older, *unused;

	while (*next != NULL && now - (*next)->retired < 2 * tls->handshake_seconds)
		next = &(*next)->older;
	unused = *next;
	*next = NULL;
	return unused;
}

int tls_reload(struct tls *tls, struct error *err)
{
	struct credentials *fresh, *unused;
	double now = clock_monotonic();

	if (tls == NULL)
		return 0;
	if (credentials_read(tls, &fresh, err) != 0)
		return err->code;
	pthread_mutex_lock(&tls->lock);
	tls->credentials->retired = now;
	fresh->older = tls->credentials;
	tls->credentials = fresh;
	unused = take_unused(tls, now);
	pthread_mutex_unlock(&tls->lock);
	credentials_free(unused);
	log_line(LEVEL_INFO, "certificate read from %s", tls->certificate);
	return 0;
}

const char *tls_trust(const struct tls *tls)
{
	return tls->trust;
}

/* ---- handshakes ---- */

typedef int handshake(gnutls_session_t session);
static handshake *gnutls_own;
static pthread_once_t own_found = PTHREAD_ONCE_INIT;

static void find_own(void)
{
	void *found = dlsym(RTLD_NEXT, "gnutls_handshake");

	memcpy(&gnutls_own, &found, sizeof(found));
}

/*
 * Replaces GnuTLS's, which the library calls: it closes the connection of a handshake that fails without a word. The
 * client is told why by an alert (RFC 8446, 6.2), so that its user reads of a version or a cipher and not of a network
 * that breaks.
 */
int gnutls_handshake(gnutls_session_t session)
{
	int code;

	pthread_once(&own_found, find_own);
	if (gnutls_own == NULL)
		return GNUTLS_E_INTERNAL_ERROR;
	code = gnutls_own(session);
	/* A client that has sent an alert itself knows. */
	if (code < 0 && gnutls_error_is_fatal(code) && code != GNUTLS_E_FATAL_ALERT_RECEIVED)
		gnutls_alert_send_appropriate(session, code);
	return code;
}

int tls_certificate(gnutls_session_t session, const struct gnutls_cert_retr_st *info, gnutls_pcert_st **ret_chain,
		    unsigned *ret_length, gnutls_ocsp_data_st **ret_ocsp, unsigned *ret_ocsp_length,
		    gnutls_privkey_t *ret_key, unsigned *ret_flags)
{
	struct connection *connection = gate_find(gnutls_transport_get_int(session));
	struct tls *tls;

	(void)info;
	if (connection == NULL)
		return -1;
	tls = connection->http->tls;
	pthread_mutex_lock(&tls->lock);
	*ret_chain = tls->credentials->chain;
	*ret_length = tls->credentials->chain_length;
	*ret_key = tls->credentials->key;
	pthread_mutex_unlock(&tls->lock);
	*ret_ocsp = NULL;
	*ret_ocsp_length = 0;
	*ret_flags = 0; /* they stay ours */
	return 0;
}

/* True if an authority vouches for the chain, whose first certificate is that of a client. */
static bool is_trusted(struct tls *tls, gnutls_x509_crt_t *chain, unsigned length)
{
	gnutls_typed_vdata_st purpose = {.type = GNUTLS_DT_KEY_PURPOSE_OID,
					 .data = (unsigned char *)(uintptr_t)GNUTLS_KP_TLS_WWW_CLIENT};
	gnutls_x509_trust_list_t clients;
	unsigned status = ~0u;
	int code = GNUTLS_E_NO_CERTIFICATE_FOUND;

	/* Credentials that others replace are kept for longer than this takes. */
	pthread_mutex_lock(&tls->lock);
	clients = tls->credentials->clients;
	pthread_mutex_unlock(&tls->lock);
	if (clients != NULL)
		code = gnutls_x509_trust_list_verify_crt2(clients, chain, length, &purpose, 1, 0, &status, NULL);
	return code == 0 && status == 0;
}

/* A name with more than one common name is nobody's in particular. */
static bool common_name(gnutls_x509_crt_t certificate, char *ret_name, size_t size)
{
	char second[8];
	size_t second_size = sizeof(second);

	return gnutls_x509_crt_get_dn_by_oid(certificate, GNUTLS_OID_X520_COMMON_NAME, 0, 0, ret_name, &size) == 0 &&
	       strlen(ret_name) == size &&
	       gnutls_x509_crt_get_dn_by_oid(certificate, GNUTLS_OID_X520_COMMON_NAME, 1, 0, second, &second_size) ==
		   GNUTLS_E_REQUESTED_DATA_NOT_AVAILABLE;
}

static void look_at_peer(struct connection *connection, gnutls_session_t session)
{
	gnutls_x509_crt_t chain[CHAIN_MAX];
	unsigned length = 0, imported = 0;
	const gnutls_datum_t *peers = gnutls_certificate_get_peers(session, &length);
	char name[TOKEN_NAME_SIZE];

	if (peers == NULL || length == 0 || length > CHAIN_MAX)
		return;
	while (imported < length && gnutls_x509_crt_init(&chain[imported]) == 0) {
		imported++;
		if (gnutls_x509_crt_import(chain[imported - 1], &peers[imported - 1], GNUTLS_X509_FMT_DER) != 0)
			goto out;
	}
	if (imported == length && is_trusted(connection->http->tls, chain, length) &&
	    common_name(chain[0], name, sizeof(name)))
		memcpy(connection->certificate, name, sizeof(name));
out:
	while (imported > 0)
		gnutls_x509_crt_deinit(chain[--imported]);
}

const char *tls_peer_name(struct connection *connection)
{
	if (connection->tls && !connection->certificate_read) {
		look_at_peer(connection,
			     MHD_get_connection_info(connection->mhd, MHD_CONNECTION_INFO_GNUTLS_SESSION)->tls_session);
		connection->certificate_read = true;
	}
	return connection->certificate;
}

void tls_end(struct connection *connection)
{
	if (connection->tls)
		gnutls_bye(MHD_get_connection_info(connection->mhd, MHD_CONNECTION_INFO_GNUTLS_SESSION)->tls_session,
			   GNUTLS_SHUT_WR);
}
