// DIMSE as a service class user: dimse.h. C++ is what DCMTK speaks; nothing of it leaves the dimse_*.cc.
#include <dcmtk/config/osconfig.h>

#include <dcmtk/dcmdata/dctk.h>
#include <dcmtk/dcmdata/dcistrmb.h>
#include <dcmtk/dcmnet/diutil.h>
#include <dcmtk/dcmnet/scu.h>
#include <dcmtk/oflog/oflog.h>

#include <memory>
#include <new>

#include "daemon/dicom/dimse_promise.h"
#include "daemon/dicom/dimse_transport.h"

namespace
{

const Uint32 pdu_bytes = 131072;

// Responses to C-FIND are handed on one by one, and no more than `most` are taken.
class Client : public DcmSCU
{
      public:
	int most = 0, count = 0;
	Uint16 status = 0;
	DcmTransportLayer *layer = nullptr; // outlives the client
	void *context = nullptr;
	void (*take)(void *context, DcmDataset *dataset) = nullptr;

	OFCondition initNetwork() override
	{
		OFCondition condition = DcmSCU::initNetwork();

		return condition.good() ? useSecureConnection(layer) : condition;
	}

	OFCondition handleFINDResponse(const T_ASC_PresentationContextID presentation, QRResponse *response,
				       OFBool &again) override
	{
		status = response->m_status;
		again = DICOM_PENDING_STATUS(status);
		if (again && response->m_dataset != nullptr && count < most) {
			count++;
			take(context, response->m_dataset);
		}
		if (again && count >= most) {
			sendCANCELRequest(presentation);
			again = OFFalse;
		}
		return EC_Normal;
	}

	// N-CREATE or N-SET, which DcmSCU has not. *ret_error: Error ID (0000,0903), 0: none. An answer to another message
	// than this one, or about another step than UID, is a bad one.
	OFCondition request(T_ASC_PresentationContextID presentation, T_DIMSE_Message *message, const char *uid,
			    DcmDataset *dataset, Uint16 *ret_status, Uint16 *ret_error)
	{
		const bool creates = message->CommandField == DIMSE_N_CREATE_RQ;
		DcmDataset *detail = nullptr, *attributes = nullptr;
		T_DIMSE_Message reply = {};
		const T_DIMSE_N_CreateRSP &created = reply.msg.NCreateRSP;
		const T_DIMSE_N_SetRSP &changed = reply.msg.NSetRSP;
		OFCondition condition = sendDIMSEMessage(presentation, message, dataset);

		if (condition.good())
			condition = receiveDIMSECommand(&presentation, &reply, &detail);
		if (condition.bad())
			return condition;
		if (reply.CommandField != (creates ? DIMSE_N_CREATE_RSP : DIMSE_N_SET_RSP)) {
			delete detail;
			return DIMSE_BADMESSAGE;
		}
		*ret_error = 0;
		if (detail != nullptr)
			detail->findAndGetUint16(DCM_ErrorID, *ret_error);
		delete detail;
		*ret_status = creates ? created.DimseStatus : changed.DimseStatus;
		if ((creates ? created.DataSetType : changed.DataSetType) != DIMSE_DATASET_NULL)
			condition = receiveDIMSEDataset(&presentation, &attributes);
		delete attributes;
		const int answered = creates ? created.MessageIDBeingRespondedTo : changed.MessageIDBeingRespondedTo;
		const bool named = creates ? created.opts & O_NCREATE_AFFECTEDSOPINSTANCEUID
					   : changed.opts & O_NSET_AFFECTEDSOPINSTANCEUID;
		const char *about = creates ? created.AffectedSOPInstanceUID : changed.AffectedSOPInstanceUID;

		if (condition.good() && (answered != requests || (named && strcmp(about, uid) != 0)))
			return DIMSE_BADMESSAGE;
		return condition;
	}

	Uint16 requests = 0; // such ones, on an association that has no others

	const void *sent_context = nullptr;
	void (*sent)(const void *context, size_t bytes) = nullptr;

	void notifySENDProgress(const unsigned long bytes) override
	{
		if (sent != nullptr)
			sent(sent_context, bytes);
	}
};

const char *class_of(enum dimse_service service, const char *class_uid)
{
	switch (service) {
	case DIMSE_FIND:
		return UID_FINDStudyRootQueryRetrieveInformationModel;
	case DIMSE_STORE:
		return class_uid;
	case DIMSE_COMMIT:
		return UID_StorageCommitmentPushModelSOPClass;
	case DIMSE_STEP:
		return UID_ModalityPerformedProcedureStepSOPClass;
	case DIMSE_WORKLIST:
		return UID_FINDModalityWorklistInformationModel;
	default:
		return UID_VerificationSOPClass;
	}
}

// The text of a condition names hosts and states of the protocol, and no value of a dataset.
int broken(const char *what, const OFCondition &condition, struct error *err)
{
	return error_set(err, ERR_IO, "%s: %.160s", what, condition.text());
}

} // namespace

struct dimse {
	PromptLayer plain;
	std::unique_ptr<SecureLayer> secure; // where the peer has an authority
	Client client;                       // ends before its layer
	T_ASC_PresentationContextID presentation = 0;
};

int dimse_open(const struct dimse_peer *peer, enum dimse_service service, const char *class_uid,
	       struct dimse **ret_dimse, struct error *err)
{
	const char *wanted = class_of(service, class_uid);
	OFList<OFString> syntaxes;
	struct dimse *dimse;
	OFCondition condition;

	OFLog::configure(OFLogger::OFF_LOG_LEVEL);
	dimse = new (std::nothrow) struct dimse;
	if (dimse == nullptr)
		return error_set(err, ERR_NO_MEMORY, "no memory for an association");
	syntaxes.push_back(UID_LittleEndianExplicitTransferSyntax);
	if (service != DIMSE_STORE)
		syntaxes.push_back(UID_LittleEndianImplicitTransferSyntax);
	Client &client = dimse->client;
	client.layer = &dimse->plain;
	if (peer->authority[0] != '\0') {
		int code;

		dimse->secure.reset(new (std::nothrow) SecureLayer);
		code = dimse->secure ? dimse->secure->prepare(peer, err)
				     : error_set(err, ERR_NO_MEMORY, "no memory for TLS");
		if (code != 0) {
			delete dimse;
			return code;
		}
		client.layer = dimse->secure.get();
	}
	client.setAETitle(peer->own);
	client.setPeerHostName(peer->host);
	client.setPeerPort((Uint16)peer->port);
	client.setPeerAETitle(peer->title);
	client.setConnectionTimeout(peer->seconds);
	client.setACSETimeout((Uint32)peer->seconds);
	client.setDIMSEBlockingMode(DIMSE_NONBLOCKING);
	client.setDIMSETimeout((Uint32)peer->seconds);
	client.setMaxReceivePDULength(pdu_bytes);
	client.addPresentationContext(wanted, syntaxes);
	condition = client.initNetwork();
	if (condition.good())
		condition = client.negotiateAssociation();
	// The one context that is proposed may be what the peer does not accept.
	if (condition == NET_EC_NoAcceptablePresentationContexts ||
	    condition == DUL_NOASSOCIATIONREQUEST /* none of ours */) {
		delete dimse;
		return error_set(err, ERR_NOT_FOUND, "it does not know %s", dcmFindNameOfUID(wanted, wanted));
	}
	if (condition == DUL_ASSOCIATIONREJECTED) {
		delete dimse;
		return error_set(err, ERR_IO, "it refuses the association: does it know %.16s, and is it %.16s?",
				 peer->own, peer->title);
	}
	if (condition.bad()) {
		const char *refused = dimse->secure ? dimse->secure->refused : nullptr;

		delete dimse;
		return refused != nullptr ? error_set(err, ERR_BUSY, "its certificate is refused: %.100s", refused)
					  : error_set(err, ERR_BUSY, "it cannot be reached: %.160s", condition.text());
	}
	dimse->presentation = client.findAnyPresentationContextID(wanted, UID_LittleEndianExplicitTransferSyntax);
	if (dimse->presentation == 0) {
		dimse_close(dimse);
		return error_set(err, ERR_NOT_FOUND, "it does not know %s", dcmFindNameOfUID(wanted, wanted));
	}
	*ret_dimse = dimse;
	return 0;
}

void dimse_close(struct dimse *dimse)
{
	if (dimse == nullptr)
		return;
	if (dimse->client.isConnected())
		dimse->client.releaseAssociation();
	delete dimse;
}

int dimse_echo(struct dimse *dimse, struct error *err)
{
	OFCondition condition = dimse->client.sendECHORequest(dimse->presentation);

	return condition.good() ? 0 : broken("C-ECHO", condition, err);
}

/* ---- C-FIND ---- */

static int find(struct dimse *dimse, DcmDataset *keys, int most, void (*take)(void *context, DcmDataset *dataset),
		void *context, const char *what, struct error *err)
{
	Client &client = dimse->client;

	client.most = most;
	client.count = 0;
	client.take = take;
	client.context = context;
	OFCondition condition = client.sendFINDRequest(dimse->presentation, keys, nullptr);
	if (condition.bad())
		return broken(what, condition, err);
	if (client.status != STATUS_Success && !DICOM_PENDING_STATUS(client.status) &&
	    client.status != STATUS_FIND_Cancel_MatchingTerminatedDueToCancelRequest)
		return error_set(err, ERR_IO, "it answered %s with status 0x%04x", what, client.status);
	return 0;
}

struct instances {
	void (*found)(void *context, const char *instance);
	void *context;
};

static void take_instance(void *context, DcmDataset *dataset)
{
	const struct instances *instances = static_cast<const struct instances *>(context);
	OFString instance;

	if (dataset->findAndGetOFString(DCM_SOPInstanceUID, instance).good())
		instances->found(instances->context, instance.c_str());
}

int dimse_find(struct dimse *dimse, const char *study, const char *series, int most,
	       void (*found)(void *context, const char *instance), void *context, struct error *err)
{
	struct instances instances = {found, context};
	DcmDataset keys;

	keys.putAndInsertString(DCM_QueryRetrieveLevel, "IMAGE");
	keys.putAndInsertString(DCM_StudyInstanceUID, study);
	keys.putAndInsertString(DCM_SeriesInstanceUID, series);
	keys.putAndInsertString(DCM_SOPInstanceUID, "");
	return find(dimse, &keys, most, take_instance, &instances, "C-FIND", err);
}

/* ---- C-STORE ---- */

int dimse_store(struct dimse *dimse, const uint8_t *bytes, size_t size, void (*sent)(const void *context, size_t bytes),
		const void *context, struct error *err)
{
	DcmInputBufferStream stream;
	DcmFileFormat file;
	Uint16 status = 0;

	stream.setBuffer(bytes, (offile_off_t)size);
	stream.setEos();
	file.transferInit();
	OFCondition condition = file.read(stream);
	file.transferEnd();
	if (condition.bad())
		return error_set(err, ERR_INTERNAL, "an object that was made is none: %.100s", condition.text());
	dimse->client.sent = sent;
	dimse->client.sent_context = context;
	condition = dimse->client.sendSTORERequest(dimse->presentation, "", file.getDataset(), status);
	if (condition.bad())
		return broken("C-STORE", condition, err);
	// 0xB000 and above are warnings of what was stored: coerced elements, or elements that are discarded.
	if (status != STATUS_Success && (status & 0xF000) != 0xB000)
		return error_set(err, ERR_IO, "it answered C-STORE with status 0x%04x%s", status,
				 (status & 0xFF00) == 0xA700 ? " (out of resources)" : "");
	return 0;
}

/* ---- storage commitment ---- */

int dimse_commit(struct dimse *dimse, const char *class_uid, const char *const *instances, int count,
		 const char *transaction, int seconds, bool *ret_answered, struct dimse_promise *ret_promise,
		 struct error *err)
{
	Client &client = dimse->client;
	DcmDataset request, *answer = nullptr;
	Uint16 status = 0, event = 0;

	request.putAndInsertString(DCM_TransactionUID, transaction);
	for (int i = 0; i < count; i++) {
		DcmItem *item = nullptr;

		// -2: a new item at the end.
		if (request.findOrCreateSequenceItem(DCM_ReferencedSOPSequence, item, -2).bad())
			return error_set(err, ERR_NO_MEMORY, "no memory for a request");
		item->putAndInsertString(DCM_ReferencedSOPClassUID, class_uid);
		item->putAndInsertString(DCM_ReferencedSOPInstanceUID, instances[i]);
	}
	OFCondition condition = client.sendACTIONRequest(dimse->presentation, UID_StorageCommitmentPushModelSOPInstance,
							 1, &request, status);
	if (condition.bad())
		return broken("N-ACTION", condition, err);
	if (status != STATUS_Success)
		return error_set(err, ERR_IO, "it answered a request for storage commitment with status 0x%04x",
				 status);
	*ret_answered = client.handleEVENTREPORTRequest(answer, event, seconds).good() && answer != nullptr &&
			promise_read(answer, ret_promise);
	delete answer;
	return 0;
}

/* ---- modality worklist ---- */

struct steps {
	const struct dimse_query *query;
	void (*found)(void *context, const struct dimse_step *step);
	void *context;
};

static const struct {
	DcmTagKey tag;
	bool scheduled; // in the Scheduled Procedure Step Sequence
} step_tags[STEP_FIELDS] = {
    {DCM_ScheduledProcedureStepID, true},          {DCM_RequestedProcedureID, false},
    {DCM_ScheduledProcedureStepDescription, true}, {DCM_ScheduledProcedureStepStartDate, true},
    {DCM_ScheduledProcedureStepStartTime, true},   {DCM_Modality, true},
    {DCM_ScheduledStationAETitle, true},           {DCM_ScheduledPerformingPhysicianName, true},
};

static void take_step(void *context, DcmDataset *dataset)
{
	const struct steps *steps = static_cast<const struct steps *>(context);
	OFString field[STEP_FIELDS], subject[STEP_SUBJECT_MOST];
	struct dimse_step step = {};
	DcmItem *scheduled = nullptr;

	// What cannot be converted stays as it is.
	dataset->convertToUTF8();
	dataset->findAndGetSequenceItem(DCM_ScheduledProcedureStepSequence, scheduled);
	for (int i = 0; i < STEP_FIELDS; i++) {
		DcmItem *item = step_tags[i].scheduled ? scheduled : dataset;

		if (item != nullptr)
			item->findAndGetOFString(step_tags[i].tag, field[i]);
		step.field[i] = field[i].c_str();
	}
	for (int i = 0; i < steps->query->subject_count; i++) {
		const uint16_t *tag = steps->query->subject[i];

		dataset->findAndGetOFString(DcmTagKey(tag[0], tag[1]), subject[i]);
		step.subject[i] = subject[i].c_str();
	}
	steps->found(steps->context, &step);
}

int dimse_worklist(struct dimse *dimse, const struct dimse_query *query,
		   void (*found)(void *context, const struct dimse_step *step), void *context, struct error *err)
{
	struct steps steps = {query, found, context};
	DcmItem *scheduled = nullptr;
	DcmDataset keys;

	for (int i = 0; i < query->subject_count; i++)
		keys.insertEmptyElement(DcmTagKey(query->subject[i][0], query->subject[i][1]));
	if (keys.findOrCreateSequenceItem(DCM_ScheduledProcedureStepSequence, scheduled).bad())
		return error_set(err, ERR_NO_MEMORY, "no memory for a query");
	for (int i = 0; i < STEP_FIELDS; i++)
		(step_tags[i].scheduled ? scheduled : &keys)->insertEmptyElement(step_tags[i].tag);
	const OFString range =
	    OFString(query->from) == query->to ? OFString(query->from) : OFString(query->from) + "-" + query->to;
	scheduled->putAndInsertOFStringArray(DCM_ScheduledProcedureStepStartDate, range);
	scheduled->putAndInsertString(DCM_Modality, query->modality);
	scheduled->putAndInsertString(DCM_ScheduledStationAETitle, query->station);
	return find(dimse, &keys, query->most, take_step, &steps, "C-FIND of the worklist", err);
}

/* ---- modality performed procedure steps ---- */

static bool fill(DcmItem *item, const cJSON *attributes)
{
	bool good = true;
	const cJSON *member, *one;

	cJSON_ArrayForEach(member, attributes)
	{
		const unsigned long number = strtoul(member->string, nullptr, 16);
		const DcmTag tag((Uint16)(number >> 16), (Uint16)(number & 0xffff));

		if (cJSON_IsString(member)) {
			good = good && item->putAndInsertString(tag, member->valuestring).good();
			continue;
		}
		good = good && item->insertEmptyElement(tag).good();
		cJSON_ArrayForEach(one, member)
		{
			DcmItem *inner = nullptr;

			// -2: a new item at the end.
			good = good && item->findOrCreateSequenceItem(tag, inner, -2).good() && fill(inner, one);
		}
	}
	return good;
}

// Warnings are of what was taken: attributes that are optional, or beyond what the peer keeps.
static int judge_step(const char *what, Uint16 status, struct error *err)
{
	static const Uint16 taken[] = {STATUS_Success, STATUS_N_MPPS_Warning_RequestedOptionalAttributesNotSupported,
				       STATUS_N_AttributeListError, STATUS_N_AttributeValueOutOfRange};

	for (Uint16 one : taken)
		if (status == one)
			return 0;
	return error_set(err, ERR_IO, "it answered %s with status 0x%04x", what, status);
}

int dimse_step_create(struct dimse *dimse, const char *uid, const cJSON *attributes, struct error *err)
{
	T_DIMSE_Message message = {};
	T_DIMSE_N_CreateRQ &request = message.msg.NCreateRQ;
	Uint16 status = 0, error = 0;
	DcmDataset dataset;

	if (!fill(&dataset, attributes))
		return error_set(err, ERR_INTERNAL, "a performed procedure step that was made is none");
	message.CommandField = DIMSE_N_CREATE_RQ;
	request.MessageID = ++dimse->client.requests;
	request.DataSetType = DIMSE_DATASET_PRESENT;
	request.opts = O_NCREATE_AFFECTEDSOPINSTANCEUID;
	OFStandard::strlcpy(request.AffectedSOPClassUID, UID_ModalityPerformedProcedureStepSOPClass,
			    sizeof(request.AffectedSOPClassUID));
	OFStandard::strlcpy(request.AffectedSOPInstanceUID, uid, sizeof(request.AffectedSOPInstanceUID));
	OFCondition condition = dimse->client.request(dimse->presentation, &message, uid, &dataset, &status, &error);
	if (condition.bad())
		return broken("N-CREATE", condition, err);
	if (status == STATUS_N_DuplicateSOPInstance)
		return 0;
	return judge_step("N-CREATE", status, err);
}

int dimse_step_set(struct dimse *dimse, const char *uid, const cJSON *attributes, struct error *err)
{
	const Uint16 ended_already = 0xa506; // PS3.4 F.7.2.2.2: it may no longer be updated
	T_DIMSE_Message message = {};
	T_DIMSE_N_SetRQ &request = message.msg.NSetRQ;
	Uint16 status = 0, error = 0;
	DcmDataset dataset;

	if (!fill(&dataset, attributes))
		return error_set(err, ERR_INTERNAL, "a performed procedure step that was made is none");
	message.CommandField = DIMSE_N_SET_RQ;
	request.MessageID = ++dimse->client.requests;
	request.DataSetType = DIMSE_DATASET_PRESENT;
	OFStandard::strlcpy(request.RequestedSOPClassUID, UID_ModalityPerformedProcedureStepSOPClass,
			    sizeof(request.RequestedSOPClassUID));
	OFStandard::strlcpy(request.RequestedSOPInstanceUID, uid, sizeof(request.RequestedSOPInstanceUID));
	OFCondition condition = dimse->client.request(dimse->presentation, &message, uid, &dataset, &status, &error);
	if (condition.bad())
		return broken("N-SET", condition, err);
	if (status == STATUS_N_NoSuchSOPInstance)
		return error_set(err, ERR_NOT_FOUND, "it does not know the performed step");
	if (status == STATUS_N_ProcessingFailure && error == ended_already)
		return 0;
	return judge_step("N-SET", status, err);
}
